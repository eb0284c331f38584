"""Other processes that tests start: browsers, validators, compilers, children that are stopped."""

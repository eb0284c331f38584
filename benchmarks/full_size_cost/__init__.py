"""The cost of a guided run: the model, what is watched in the program, and single steps of it."""

"""Small pictures of made-up scenes, from which the networks learn."""

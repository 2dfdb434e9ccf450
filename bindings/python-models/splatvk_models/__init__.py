"""Models of splatvk, in the folder `models` beside this file."""

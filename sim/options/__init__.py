"""Options of a Runner: their declaration and checks."""

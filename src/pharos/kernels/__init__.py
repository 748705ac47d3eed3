"""Compiled loops: flat arrays in, flat arrays out, nothing else. Importing a module here loads Numba."""

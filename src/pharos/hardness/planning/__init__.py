"""How far ahead one must look: effective horizons, GORP, and the values of every step of an episode."""

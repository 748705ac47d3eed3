"""Distances without chance: diameter and start eccentricity, by searches on the graph of transitions."""

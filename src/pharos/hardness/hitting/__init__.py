"""Distances under chance: expected hitting times with certificates, and diameters made of them."""

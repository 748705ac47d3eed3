"""The slow twins in plain Python and NumPy that fast code is compared with, by area; each is written for reading, not
for speed.

builder: Algorithm 1 of the paper, with a dict of tuples. environments, bsuite: rules once more. mdp: MDPs with every
kind of chance as full matrices, solved by linear algebra; exact: the same in fractions. gaps, hardness, hitting,
horizon, gorp, colosseum: measures from those matrices. learning: Q-learning with the same random numbers.
"""

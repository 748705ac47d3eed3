"""MiniGrid: the compiled rules, the layouts drawn again by seed, and Colosseum's two grids."""

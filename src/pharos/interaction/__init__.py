"""Stepping an environment: one (Gymnasium), many at once (vector), and those of Stable-Baselines3."""

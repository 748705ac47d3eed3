"""Suboptimality gaps, proofs of ties, and the value norm."""

"""Measures of an observation and a network: regret of idealised learners, spectra of kernels, states that look alike.

`learning.Representation` is what they take, numbers of observations and a kernel of pairs of states: so they meet
neither environments nor state spaces. `pharos.observations.representation` makes one.
"""

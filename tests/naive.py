"""The slow twins in plain Python and NumPy that fast code is compared with, by area; each is written for reading, not
for speed.

naive_builder: Algorithm 1 of the paper, with a dict of tuples. naive_environments: the rules of the four classes once
more.
naive_mdp: MDPs with every kind of chance as full matrices, solved by linear algebra. naive_gaps, naive_hardness:
measures from those matrices, and distances between all pairs.
"""

from naive_builder import *  # noqa: F403
from naive_environments import *  # noqa: F403
from naive_gaps import *  # noqa: F403
from naive_hardness import *  # noqa: F403
from naive_mdp import *  # noqa: F403

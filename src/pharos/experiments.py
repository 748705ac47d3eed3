"""The former name of `pharos.training`, which scripts may rely on."""

import sys

from pharos import training

sys.modules[__name__] = training

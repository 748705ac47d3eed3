"""The former name of what `pharos.benchmark` has, which scripts may rely on."""

import sys

from pharos import benchmark

sys.modules[__name__] = benchmark

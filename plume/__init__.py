"""The physics that all parts share: dispersion, sensors, scenarios, the world that one mission flies in.
Imports: nothing of ours.
"""

__version__ = "0.1.0"
# What a process says on stderr before it compiles its first kernel.
COMPILING = "compiling kernels, once, about 15 s"

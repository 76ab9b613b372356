"""The physics that all parts share: dispersion, problems, scenarios, draws, and how long a leg takes.
Imports: plume.polygons, plume.mistakes.
"""

__version__ = "0.1.0"
# What a process says on stderr before it compiles its first kernel.
COMPILING = "compiling kernels, once, 15 to 60 s"

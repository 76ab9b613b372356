"""The parameters of a release as arrays name them: their order, and what may be known of each beforehand."""

PARAMETERS = ("x", "y", "z", "q", "u", "phi", "d", "tau")
"""Position m (z above home), release rate g/s, wind m/s and rad, diffusivity m²/s, lifetime s."""
X, Y, Z, Q, U, PHI, D, TAU = range(8)
KNOWN, UNIFORM, NORMAL, GAMMA, MEASURED = 0.0, 1.0, 2.0, 3.0, 4.0
"""Kinds of knowledge about one: its value, a prior's family, or that each reading brings it (wind)."""

"""The parameters of a release: their order in arrays, and the kinds of prior knowledge about each."""

PARAMETERS = ("x", "y", "z", "q", "u", "phi", "d", "tau")
"""Position m (z above home), release rate g/s, wind m/s and rad, diffusivity m²/s, lifetime s."""
X, Y, Z, Q, U, PHI, D, TAU = range(8)
KNOWN, UNIFORM, NORMAL, GAMMA, MEASURED = 0.0, 1.0, 2.0, 3.0, 4.0
"""Kinds of knowledge about a parameter: known value, family of its prior, or measured with each reading (wind)."""

"""The filter's fused loops, compiled and cached. Imports: plume.

Plain IEEE arithmetic in a fixed order, exp and log included: no fastmath, no threads, no libm but for angles and rare sensors. A
mission's numbers are therefore the same bits alone or in a batch, on any number of threads. Loops are simple so that LLVM turns
them into vector instructions.

particles: (D, N), a row for each unknown.  unknowns: (D,) indices into x, y, z, q, u, φ, d, τ.
priors: (8, 5) rows of kind, a, b and the support's ends.  sensor: (5,) kind and numbers.  readings: (T, 7) rows of x, y,
height above the source's plane or home, wind_x, wind_y, gas, share: the exponent that the reading's likelihood is taken to.
"""

"""The filter's fused loops, compiled and cached.

Imports: plume, plume.sensors.

Plain IEEE arithmetic in a fixed order, exp and log included: no fastmath, no threads, no libm except for
angles and rare sensors. A mission is therefore bit-identical alone or in a batch, on any number of
threads. Loops are simple, so that LLVM can vectorise them.

particles: (D, N), one row per unknown.  unknowns: (D,) indices into `plume.parameters.PARAMETERS`.
priors: (15, 5) rows of kind, a, b and the support's ends.  sensor: (5,) kind and numbers.  readings: (T,
7) rows of x, y, height (same origin as z), wind_x, wind_y, gas and share, the exponent of the reading's
likelihood.
"""

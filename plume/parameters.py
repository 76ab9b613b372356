"""The parameters of a release and of what measures it.

Their order in arrays, the kinds of prior knowledge about each, and their limits.
"""

import math

# Of the release: position m (z above home), release rate g/s, wind m/s and rad, diffusivity m²/s, lifetime s.
#
# Of what measures it: `wind-direction` is what has to be added to the measured direction, degrees
# counter-clockwise; `wind-speed` and `gain` are factors, true speed by measured speed and reading by
# concentration; `noise` is a factor on the sensor's noise; `cv` is the gas's intermittency, the coefficient
# of variation of the concentration around the plume's mean.
PARAMETERS = (
    "x",
    "y",
    "z",
    "q",
    "u",
    "phi",
    "d",
    "tau",
    "wind-direction",
    "wind-speed",
    "gain",
    "noise",
    "cv",
    "puff-rate",
    "puff-share",
)
X, Y, Z, Q, U, PHI, D, TAU, WIND_DIRECTION, WIND_SPEED, GAIN, NOISE, CV, PUFF_RATE, PUFF_SHARE = range(15)
# Values of a faultless anemometer and sensor, and of gas without puffs.
NEUTRAL = {
    **{"wind-direction": 0.0, "wind-speed": 1.0, "gain": 1.0, "noise": 1.0},
    # Infinitely many puffs are steady gas.
    **{"puff-rate": math.inf, "puff-share": 0.2},
}
# Kinds of knowledge about a parameter: known value, family of its prior, or measured with each reading
# (wind). AROUND is uniform over an interval, and less dense beyond its ends.
KNOWN, UNIFORM, NORMAL, GAMMA, MEASURED, LOGNORMAL, AROUND = 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0
BEYOND = 0.2  # density beyond the ends of AROUND, as a share of that between them
# A sensor as compiled loops take it is a row, which `plume.sensors.names.sensor_row` fills in: its kind; α or
# e; β or b; threshold; p_m.
GAUSSIAN_KIND, THRESHOLD_KIND, HITS_KIND = 0.0, 1.0, 2.0
KIND, SLOPE, FLOOR, THRESHOLD, MISSED = range(5)
# Of an instrument: time constants of rise and decay, s, 0 if it follows at once; s that it hovers for a
# reading; the greatest reading; RS/R0 = A c^B up to that of clean air, which is 0 if it reads the gas itself;
# length of the ray that it looks along, m, 0 if it meets the gas where it is; the ray's direction, a unit
# vector.
RISE, DECAY, DWELL, SATURATION, CLEAN, FACTOR, POWER, RAY, EAST, NORTH, UP = range(5, 16)
SENSOR_NUMBERS = 16
# Share of the readings that are blank in gas that comes and goes, of C²/(1 + C²), where C is its cv.
BLANK = 0.4
GREATEST_CV = 3.0  # the strongest intermittency that the sensor model covers
# Least and greatest value of a release's parameters that may be given: far beyond any leak, and no arithmetic
# overflows between them.
LIMITS = {
    "q": (0.001, 1e6),
    "u": (0.0, 120.0),
    "d": (0.001, 1e4),
    "tau": (0.001, 1e6),
    "z": (-1000.0, 1000.0),
}
# Greatest number of a sensor, a prior or a belief that is taken, in its own unit; squares and products of
# such numbers are finite.
MOST = 1e12

"""Building blocks of planners: moves, and predictions of future readings. Imports: plume, link.bus."""

"""Plumes that others have filmed or computed, read from their files and flown in: movies, results of GADEN.

Imports: plume, plume.mistakes.
"""

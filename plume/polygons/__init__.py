"""Polygons that ways keep out of or in: straight ways, their gaps, and the shortest ways around corners.

Imports: nothing of ours.
"""

"""Gas sensors: how their readings are drawn, their likelihoods, and their names.

Imports: plume.
"""

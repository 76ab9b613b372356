"""Judging policies, with the true source known: missions in-process, sweeps over many, their figures.

Imports: plume, plume.worlds, link, link.bus, estimator, agent, agent.planning.
"""

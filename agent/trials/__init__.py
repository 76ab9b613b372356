"""Judging policies, with the true source known: missions in-process, sweeps over many, their figures.

Imports: plume, plume.sensors, plume.worlds, plume.problems, link, link.bus, estimator, agent,
agent.planning.
"""

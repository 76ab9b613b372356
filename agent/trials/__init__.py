"""What judges, and so may hold the truth: missions in-process, sweeps over many, their figures.

Imports: plume, link, link.bus, estimator, agent, agent.planning.
"""

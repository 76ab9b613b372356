"""Training: many missions in parallel, and the gymnasium environments over them.

Imports: plume, plume.worlds, scene, estimator, agent, agent.planning.
"""

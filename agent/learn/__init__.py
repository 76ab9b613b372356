"""Training: many missions in parallel, and the gymnasium environments over them.

Imports: plume, plume.sensors, plume.worlds, plume.problems, scene, estimator, agent, agent.planning.
"""

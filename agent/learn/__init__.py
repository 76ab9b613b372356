"""Training: many missions in parallel, and the environments over them.

Imports: plume, plume.sensors, plume.worlds, plume.problems, link, scene, estimator, agent, agent.planning,
agent.trials.
"""

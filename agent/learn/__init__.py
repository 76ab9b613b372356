"""Training: many missions in parallel, and the environments over them.

Imports: plume, plume.worlds, scene, estimator, agent, agent.planning, agent.trials.
"""

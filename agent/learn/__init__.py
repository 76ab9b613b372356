"""Training: many missions in parallel, and the gymnasium environments over them.

Imports: plume, scene, estimator, agent, agent.planning.
"""

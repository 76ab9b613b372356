"""Training runs: recipes, the loop around stable-baselines3, the export of trained policies.

Imports: plume, plume.problems, link, agent, agent.trials, agent.learn.
"""

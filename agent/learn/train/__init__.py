"""Training runs: recipes, the loop around stable-baselines3, the export of what was learned.

Imports: plume, link, agent, agent.trials, agent.learn.
"""

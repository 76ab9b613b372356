"""The tables, pictures and page of a report on missions that `evaluate` flew.

Imports: plume, link, scene, agent, agent.trials.
"""

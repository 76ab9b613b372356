"""The agent: takes beliefs and answers with waypoints, by planners and learned policies.

Imports: plume, plume.sensors, plume.problems, link, link.bus, agent.planning, agent.planners.
"""

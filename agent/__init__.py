"""What flies: beliefs in, waypoints out, by planners and learned policies.

Imports: plume, link, link.bus, agent.planning, agent.planners.
"""

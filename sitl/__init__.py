"""The simulated vehicle, its autopilot protocol, the router and the launcher of whole missions."""

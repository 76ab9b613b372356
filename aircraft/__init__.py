"""What flies, as the search sees it: flight modes, the words of an operator, and the interface of a
vehicle.

Imports: link.bus, sitl.autopilot.
"""

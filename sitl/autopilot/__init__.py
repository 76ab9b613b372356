"""The simulated vehicle: motion, flight modes, telemetry, and the MAVLink protocol of its autopilot. Imports: link.bus."""

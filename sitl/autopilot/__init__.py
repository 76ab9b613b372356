"""The simulated vehicle: motion, flight modes, telemetry and the autopilot's MAVLink protocol. Imports: plume, link.bus."""

"""Mission scripts: what is flown, what goes wrong meanwhile, and what is expected of it. Imports: plume, sitl.autopilot."""

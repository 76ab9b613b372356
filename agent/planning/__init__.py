"""What planners are made of: moves, and what a belief predicts of readings not yet taken. Imports: plume, link.bus."""

"""The particle filter, the belief that it publishes, and cessation (AGDC)."""

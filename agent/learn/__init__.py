"""Training: many missions in parallel, and the gymnasium environments over them. Imports: plume, estimator, agent, agent.planning."""

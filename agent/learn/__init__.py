"""What trains: many missions side by side, and the gymnasium environments over them. Imports: plume, estimator, agent, agent.planning."""

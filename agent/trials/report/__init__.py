"""The tables, pictures and the page of a report, from the missions that `evaluate` flew. Imports: plume, link, agent, agent.trials."""

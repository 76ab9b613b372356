"""The gymnasium environments by their names."""

ENVIRONMENTS = {"plumeward/SourceSearch-v0": False, "plumeward/SourceSearchContinuous-v0": True}
"""The name of each, and whether its actions are continuous."""


def register() -> None:
    """Register the environments, once. Does nothing without gymnasium, which the extra `train` installs."""
    try:
        import gymnasium
    except ModuleNotFoundError as error:
        if error.name != "gymnasium":
            raise
        return
    for name, continuous in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="agent.learn.env:SourceSearch",
                vector_entry_point="agent.learn.env:SourceSearchVector",
                kwargs={"continuous": continuous},
            )

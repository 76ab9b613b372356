"""Export of a trained learner to a bundle."""

from pathlib import Path

import msgspec
from stable_baselines3.common.base_class import BaseAlgorithm

from agent.bundle import FORMAT, CurvePoint, Page, write
from agent.learn.env import Settings
from agent.learn.train.graph import graph
from agent.learn.train.loop import layers_of
from agent.learn.train.recipes import Recipe
from agent.observation import SCHEMAS


def export(model: BaseAlgorithm, recipe: Recipe, seed: int, curve: list[CurvePoint], path: Path) -> None:
    """Write the policy of a learner to a bundle, with its recipe and training curve."""
    settings = Settings(**recipe.env)
    schema = SCHEMAS[settings.observation]
    page = Page(
        format=FORMAT,
        algorithm=recipe.algorithm,
        schema=settings.observation,
        schema_version=schema.version,
        observation=schema.size,
        move=settings.move,
        seed=seed,
        training=msgspec.to_builtins(recipe),
        curve=curve,
        evaluation={},
    )
    write(path, page, graph(layers_of(model)))

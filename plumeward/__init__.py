"""Plumeward: the public face. `import plumeward` registers the gymnasium environments; `plumeward` is the one command.

Imports: plume, link.
"""

from plume import __version__
from plumeward.environments import register

__all__ = ["__version__"]

register()

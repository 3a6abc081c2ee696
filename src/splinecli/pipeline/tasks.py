"""A task for another process, and the error that stands in place of its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from splinecli.errors import SplinecliError


class LostError(SplinecliError):
    """A worker was lost, or has too little memory: the task was not done, others may be."""


@dataclass
class Task:
    """A task: the arguments of Work.do, the bytes of memory that it takes, and how many workers it has lost."""

    args: tuple[Any, ...]
    name: str
    memory: float = 0.0
    losses: int = 0

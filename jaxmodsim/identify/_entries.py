"""Numbers that are arrays, entry by entry: `law.k` of three elements is `law.k[0]` to `law.k[2]`."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from .._core.parameters import Range


def entry_names(name: str, number: Any) -> tuple[str, ...]:
    """Names of the entries of a number; that of a single one is its own."""
    return tuple(f"{name}[{i}]" for i in range(jnp.size(number))) if jnp.ndim(number) == 1 else (name,)


def split_entries(numbers: Mapping[str, Array]) -> dict[str, Array]:
    """Single numbers by name; arrays of more than one axis stay as they are."""
    split: dict[str, Array] = {}
    for name, number in numbers.items():
        if jnp.ndim(number) == 1:
            split |= {entry: number[i] for i, entry in enumerate(entry_names(name, number))}
        else:
            split[name] = number
    return split


def split_ranges(numbers: Mapping[str, Array], ranges: Mapping[str, Range]) -> dict[str, Range]:
    """Ranges of the entries; a limit by an array is that by the entry of the same index."""
    split: dict[str, Range] = {}
    for name, allowed in ranges.items():
        for i, entry in enumerate(entry_names(name, numbers[name])):
            lower = allowed.lower
            if isinstance(lower, str) and jnp.ndim(numbers[lower]) == 1:
                lower = entry_names(lower, numbers[lower])[i]
            split[entry] = replace(allowed, lower=lower)
    return split


def join_entries(numbers: Mapping[str, Array], values: Mapping[str, Array]) -> dict[str, Array]:
    """Whole numbers with the entries in `values` replaced, those that have any."""
    joined: dict[str, Array] = {}
    for name, number in numbers.items():
        entries = entry_names(name, number)
        if not any(entry in values for entry in entries):
            continue
        if jnp.ndim(number) == 1:
            joined[name] = jnp.stack([jnp.asarray(values.get(entry, number[i])) for i, entry in enumerate(entries)])
        else:
            joined[name] = values[name]
    return joined


def chosen_entries(numbers: Mapping[str, Array], free: Sequence[str]) -> Sequence[str]:
    """Entries that `free` names, where the name of an array stands for all of them."""
    if isinstance(free, str):
        return free  # refused where it is used
    return tuple(entry for name in free for entry in (entry_names(name, numbers[name]) if name in numbers else (name,)))

"""Inputs, outputs and registers as they are indexed: ``robot.di[3] = True``."""

from __future__ import annotations

from typing import Callable, Dict, Generic, Iterator, List, Mapping, Sequence, TypeVar, Union

Value = Union[bool, int, float]
T = TypeVar("T", bound=Value)


class Group(Generic[T]):
    """Items of one kind, counted from 1 as in the controller's documentation."""

    def __init__(
        self,
        name: str,
        count: int,
        convert: Callable[[Value], T],
        get: Callable[[Sequence[str]], Dict[str, Value]],
        set_items: Callable[[Mapping[str, Value]], None],
    ) -> None:
        self._name, self._count, self._convert = name, count, convert
        self._get, self._set = get, set_items

    def __getitem__(self, index: int) -> T:
        """The value of the item; raises :class:`IndexError` if there is no such item."""
        item = self._item(index)
        return self._convert(self._get([item])[item])

    def __setitem__(self, index: int, value: T) -> None:
        """Sets it; raises :class:`~duco_sim.Refused` for a value out of its range."""
        self._set({self._item(index): value})

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[T]:
        """All values, from item 1 on, of one instant."""
        return iter(self.values())

    def values(self) -> List[T]:
        """All values, from item 1 on, of one instant."""
        items = [self._item(index) for index in range(1, self._count + 1)]
        values = self._get(items)
        return [self._convert(values[item]) for item in items]

    def __repr__(self) -> str:
        return f"<{self._name}[1..{self._count}]>"

    def _item(self, index: int) -> str:
        if not isinstance(index, int) or not 1 <= index <= self._count:
            raise IndexError(f"there is no {self._name}[{index}]; there are {self._name}[1..{self._count}]")
        return f"{self._name}[{index}]"

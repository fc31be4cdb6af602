"""One registry of methods: from a name, parameters or a stored row to what runs.

A stage has methods. A method is stage, name, version, frozen parameters and a function. Each stage's package lists its
methods in one `Stage`; this module knows only where, so it loads no detector and no JAX. docs/extending.md shows how to
add a method.

Methods of one function that differ only in parameters are a family. A stored row names its family among its parameters,
under the stage's `kind` ("detector", "solver", "family"). A row without that key belongs to the family of its own name.
"""

from __future__ import annotations

import dataclasses
import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Generic, Protocol, TypeVar

from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from pbl_pipeline.paramset import Paramset

P = TypeVar("P")
P_co = TypeVar("P_co", covariant=True)

#: Every stage, and where its methods are listed: loaded when they are first asked for.
STAGES = {
    "tracking": "pbl_pipeline.tracking:METHODS",
    "subject": "pbl_pipeline.tracking:SUBJECT_METHODS",
    "keypoints": "pbl_pipeline.keypoints:METHODS",
    "fit": "pbl_pipeline.fit:METHODS",
    "gait": "pbl_pipeline.gait.events:METHODS",
    "gdi": "pbl_pipeline.gait:GDI_METHODS",
    "kinetics": "pbl_pipeline.kinetics:METHODS",
}


def of_stage(name: str) -> Stage[Any]:
    """The methods of a stage, one of `STAGES`."""
    return pkgutil.resolve_name(STAGES[name])


def stored(*, stage: str, name: str, version: int, params: Mapping[str, Any], sha: str) -> Method[Any]:
    """The method of a row of a method table, checked against the row's hash.

    Raises `PblError` SOLVER_UNKNOWN where this version has no such function or parameters, or where the row was
    edited.
    """
    method: Method[Any] = of_stage(stage).of(Paramset(stage, name, version, params))
    if method.hash != sha:
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"{stage} method {method.key} with hash {sha}, whose parameters hash to {method.hash}",
            expected=f"{type(method.params).__name__} of pbl-pipeline {code_version()}, as they were stored",
            next_step="use the version of pbl-pipeline that wrote the method, or select a newer one; if the row was "
            "edited, restore the method table from the backup",
            key=method.key,
        )
    return method


@dataclasses.dataclass(frozen=True)
class Family:
    """A function and its class of parameters. `function` may be a dotted path ("package:name"), loaded when used."""

    name: str
    params: type
    function: Callable[..., Any] | str


@dataclasses.dataclass(frozen=True)
class Method(Generic[P]):
    """A method that can run: its row, the same parameters as a frozen dataclass, and its function.

    Each stage has its own arguments of `function` (docs/extending.md).
    """

    paramset: Paramset
    params: P
    family: Family

    @property
    def stage(self) -> str:
        return self.paramset.stage

    @property
    def name(self) -> str:
        return self.paramset.name

    @property
    def version(self) -> int:
        return self.paramset.version

    @property
    def key(self) -> str:
        """`<name>-v<version>`."""
        return self.paramset.key

    @property
    def hash(self) -> str:
        return self.paramset.hash

    @property
    def function(self) -> Callable[..., Any]:
        found = self.family.function
        return pkgutil.resolve_name(found) if isinstance(found, str) else found


class Provider(Protocol[P_co]):
    """Methods that depend on the machine, such as those of registered models. Each has version 1 in the library; the
    tables number the different ones that they meet under one name."""

    def names(self) -> Sequence[str]:
        """Names of the methods that this machine offers."""
        ...

    def params(self, name: str) -> P_co | None:
        """The parameters of the method of that name as it is now; None if this machine has none of that name.

        Raises `PblError` where it has one that cannot be used.
        """
        ...


class Stage(Mapping[str, Method[P]]):
    """The methods of one stage by name.

    Parameters
    ----------
    name
        The stage's name in `STAGES` and in every hash.
    kind
        The parameter that names the family, or "family" where the parameters of the stage have none.
    default
        Name of the method that is used unless one is named.
    provider
        Further methods: those that this machine offers.
    """

    def __init__(self, name: str, kind: str, default: str, provider: Provider[P] | None = None) -> None:
        self.name, self.kind, self.default = name, kind, default
        self._provider = provider
        self._methods: dict[str, Method[P]] = {}
        self.families: dict[str, Family] = {}

    def __getitem__(self, name: str) -> Method[P]:
        return self._methods[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._methods)

    def __len__(self) -> int:
        return len(self._methods)

    # ---------------------------------------------------------------------------------------------------- registration
    def register(
        self, name: str, version: int, params: P, function: Callable[..., Any] | str | None = None
    ) -> Method[P]:
        """Add a method. With a function it is the first of a family, whose name is the one that `params` states under
        `kind`, else the method's; without, it is a further method of the family with this class of parameters.

        Raises `ValueError` if the name is taken.
        """
        if name in self._methods:
            raise ValueError(f"{self.name} method {name} is registered already")
        if function is None:
            family = self._family_of(params)
        else:
            family = self.register_family(getattr(params, self.kind, name), type(params), function)
        self._methods[name] = self._method(name, version, params, family)
        return self._methods[name]

    def register_family(self, name: str, params: type, function: Callable[..., Any] | str) -> Family:
        """Add a family whose methods are all offered by the provider.

        Raises `ValueError` if the name is taken.
        """
        if name in self.families:
            raise ValueError(f"{self.name} family {name} is registered already")
        self.families[name] = Family(name, params, function)
        return self.families[name]

    # ------------------------------------------------------------------------------------------------------- resolution
    def find(self, given: Method[P] | Paramset | P | str | None = None) -> Method[P]:
        """Resolve a method: a name, also with its version (`zeni-2008-v1`) or of the machine's provider; a paramset;
        parameters of a family; None for the default.

        Raises `PblError` SOLVER_UNKNOWN; what the provider raises.
        """
        if given is None:
            return self[self.default]
        if isinstance(given, Method):
            return given
        if isinstance(given, Paramset):
            return self.of(given)
        if isinstance(given, str):
            return self._named(given)
        known = next((m for m in self.values() if m.params == given), None)
        if known is not None:
            return known
        family = self._family_of(given)
        return self._method(f"{family.name}-custom", 1, given, family)

    def make(self, name: str, version: int, params: P, family: Family | None = None) -> Method[P]:
        """Make a custom method: parameters of a family under a name. `family` decides between families with the same
        class of parameters if these name none.

        Raises `PblError` SOLVER_UNKNOWN, and `ValueError` for a value that is not of its field's type.
        """
        return self._method(name, version, params, self._family_of(params, family))

    def of(self, paramset: Paramset) -> Method[P]:
        """The method of a paramset. Raises `PblError` SOLVER_UNKNOWN."""
        family = self._family_of_row(paramset)
        fields = {f.name for f in dataclasses.fields(family.params)}
        try:
            if not isinstance(paramset.params, Mapping):
                raise TypeError(f"{paramset.params!r} instead of names and values")
            own = {k: v for k, v in paramset.params.items() if k in fields or k != self.kind}
            params: P = dataclasses.replace(paramset, params=own).to(family.params)
        except (TypeError, ValueError) as error:
            raise self._unknown(
                f"{paramset.key}, whose parameters this version does not understand: {error}",
                f"parameters of {family.params.__name__} of pbl-pipeline {code_version()}",
                "use the version of pbl-pipeline that wrote the method, or select a newer one",
            ) from error
        return self._method(paramset.name, paramset.version, params, family)

    def offered(self, name: str) -> Method[P] | None:
        """The method of that name that this machine's provider offers; None for registered and unknown names. Raises
        the provider's errors."""
        if name in self or self._provider is None:
            return None
        params = self._provider.params(name)
        return None if params is None else self.make(name, 1, params)

    def names(self) -> list[str]:
        """Every method that can be named on this machine."""
        return [*self, *(self._provider.names() if self._provider else ())]

    def registered(self, name: str) -> Method[P] | None:
        """The registered method of that name or key; None if there is none."""
        return ({m.key: m for m in self.values()} | self._methods).get(name)

    def _named(self, name: str) -> Method[P]:
        method = self.registered(name) or self.offered(name)
        if method is None:
            more = ", or add a model with `pbl models add`" if self._provider else ""
            raise self._unknown(
                f"method {name!r}", f"one of {', '.join(self.names())}", f"choose one of these names{more}"
            )
        return method

    def _method(self, name: str, version: int, params: P, family: Family) -> Method[P]:
        # As they are read back from a row: 4 in a float's place is 4.0, and hashes as such.
        params = Paramset.of(self.name, name, version, params).to(type(params))
        paramset = Paramset.of(self.name, name, version, params)
        if self.kind not in paramset.params and name != family.name:
            paramset = dataclasses.replace(paramset, params={self.kind: family.name, **paramset.params})
        return Method(paramset, params, family)

    def _family_of(self, params: Any, family: Family | None = None) -> Family:
        """The family of a parameter object: the one that it names, else `family`, else the one whose class it is."""
        name = getattr(params, self.kind, None)
        if name is None and family is not None:
            return family
        if name is None:
            name = next((f.name for f in self.families.values() if f.params is type(params)), type(params).__name__)
        family = self._family(name, "parameters")
        if not isinstance(params, family.params):
            raise self._unknown(
                f"{self.kind} {name!r} with {type(params).__name__}",
                family.params.__name__,
                "name a registered method or model, or pass parameters of that class",
            )
        return family

    def _family_of_row(self, paramset: Paramset) -> Family:
        named = paramset.params if isinstance(paramset.params, Mapping) else {}
        # Of a stage with a single family every row is of that one.
        only = next(iter(self.families)) if len(self.families) == 1 else None
        own = paramset.name if paramset.name in self.families else only
        return self._family(named.get(self.kind, own), paramset.key)

    def _family(self, name: Any, where: str) -> Family:
        if not isinstance(name, str) or name not in self.families:
            raise self._unknown(
                f"{self.kind} {name!r} in {where}",
                f"{self.kind} {' or '.join(self.families)}",
                "correct the parameters, or use the version of pbl-pipeline that they were made with",
            )
        return self.families[name]

    def _unknown(self, found: str, expected: str, next_step: str) -> PblError:
        return PblError("SOLVER_UNKNOWN", found=f"{self.name}: {found}", expected=expected, next_step=next_step)

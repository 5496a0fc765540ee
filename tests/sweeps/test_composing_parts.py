"""How settings are composed fast, with a loader of four keys: what is composed, what is set, what is kept."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import omegaconf.base
import pytest
from composing import register_resolver
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import ConfigCompositionException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from staf_torch.settings.plain import PlainSettings
from staf_torch.sweeps.hydra_compat import (
    Composer,
    PlainComposer,
    composing,
    interpolations_parsed_once,
    parse_override,
    plain_composing,
)
from staf_torch.sweeps.hydra_compat.composing import JobLoader, independent
from staf_torch.sweeps.hydra_compat.program import HAS_WHITELIST

STYLE = {"kv_sep": ":", "item_sep": ";", "exclude_keys": ["a.c"]}


class Loader:
    """Loads one configuration, in which `kernel` is the one group, and notes what it was asked for."""

    def __init__(self, **more: Any) -> None:
        self.loaded: list[list[str]] = []
        self.asked: list[str] = []
        self.more = more
        self.repository = SimpleNamespace(group_exists=self.group_exists)

    def group_exists(self, key: str) -> bool:
        self.asked.append(key)
        return key == "kernel"

    def load_configuration(self, name: str, lines: list[str], mode: RunMode) -> DictConfig:
        assert (name, mode) == ("config", RunMode.RUN)
        self.loaded.append(lines)
        kernel = [line.partition("=")[2] for line in lines if line.startswith("kernel=")]
        hydra = {"overrides": {"task": [], "hydra": []}, "job": {"config": {"override_dirname": STYLE}}}
        tree = {"seed": 0, "a": {"b": 1, "c": [1, 2]}, "kernel": kernel[-1] if kernel else "own"}
        cfg = OmegaConf.create({**tree, **self.more, "hydra": hydra})
        cfg.hydra.job.override_dirname = ""
        OmegaConf.set_struct(cfg, True)
        OmegaConf.set_readonly(cfg.hydra, True)
        own = [line for line in lines if not line.startswith(("kernel=", "hydra."))]
        composing.ConfigLoaderImpl._apply_overrides_to_config(
            OverridesParser.create().parse_overrides(own), cfg
        )
        return cfg

    def extra(self) -> str:
        return "of Hydra"


def values(cfg: DictConfig) -> tuple[Any, ...]:
    return cfg.seed, cfg.a.b, cfg.kernel


def composer(loader: Any = None, **options: Any) -> Composer:
    return Composer(loader or Loader(), **options)


@pytest.mark.parametrize("way", ["called", "reused"])
def test_a_choice_is_loaded_once_and_its_values_are_set(way: str) -> None:
    loader = Loader()
    make = composer(loader, hydra_node=False)
    for seed, kernel in ((3, "x"), (4, "x"), (4, "y"), (5, "y"), (5, "x")):
        compose = make if way == "called" else make.reused
        found = compose([f"seed={seed}", f"kernel={kernel}", "a.b=7"])
        assert values(found) == (seed, 7, kernel)
        assert "hydra" not in found
    assert loader.loaded == [["kernel=x"], ["kernel=y"]]
    assert values(make([])) == (0, 1, "own")
    assert sorted(loader.asked) == ["a.b", "kernel", "seed"]  # once each


def test_an_object_is_used_again_where_the_same_keys_have_other_values() -> None:
    make = composer()
    first = make.reused(["seed=1", "a.b=2"])
    assert make.reused(["seed=1", "a.b=3"]) is first
    assert values(first) == (1, 3, "own")
    for other in (["a.b=3"], ["a.b=4", "seed=1"], ["a.b=4", "seed=1", "kernel=x"]):
        found = make.reused(other)
        assert found is not first
        first = found
    assert values(first) == (1, 4, "x")
    assert make.reused(["a.b=5", "seed=1", "kernel=x"]) is first
    assert make(["a.b=5", "seed=1", "kernel=x"]) is not first
    assert make.reused(["a.c=${seed}", "seed=1"]) is not make.reused(["a.c=${seed}", "seed=1"])


def test_overrides_that_all_share_are_set_once(monkeypatch: pytest.MonkeyPatch) -> None:
    make = composer(hydra_node=False, always=["seed=3"])
    set_now: list[list[str]] = []
    apply = make._apply

    def noted(given: Any, cfg: Any) -> Any:
        set_now.append([one.input_line for one in given])
        return apply(given, cfg)  # type: ignore[misc]

    monkeypatch.setattr(make, "_apply", noted)
    for b in (5, 6):
        assert values(make(["seed=3", f"a.b={b}"])) == (3, b, "own")
    assert set_now == [["seed=3"], ["a.b=5"], ["a.b=6"]]
    assert values(make(["seed=3", "++seed=4"])) == (4, 1, "own")  # not independent: in their order
    assert set_now[3:] == [[], ["seed=3", "++seed=4"]]


def test_hydra_composes_what_nothing_else_can() -> None:
    line = ["seed=3", "kernel=x"]
    for odd in ("no function", "a search path", "no repository"):
        loader: Any = Loader()
        if odd == "no repository":
            loader.repository = None
        make = composer(loader, hydra_node=False)
        if odd == "no function":
            make._apply = None
        given = [*line, "hydra.searchpath=[a]"] if odd == "a search path" else line
        assert make.choices(given) == (("seed=3", "kernel=x") if odd == "no repository" else None)
        for _ in range(2):
            found = make(given)
            assert values(found)[2] == "x"
            assert "hydra" not in found
        assert loader.loaded[0] == given
    assert composer().choices([*line, "hydra.job.name=a"]) == ("kernel=x", "hydra.job.name=a")
    assert composer().choices(["kernel={a: 1}", "seed=1"]) == ()


def test_lines_are_parsed_once_and_not_kept_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    loader = Loader()
    make = composer(loader)
    monkeypatch.setattr(composing, "MOST_LINES", 2)
    one = make.parsed("seed=1")
    assert make.parsed("seed=1") is one
    make.parsed("seed=2")
    assert make.parsed("seed=1") is one
    assert list(make._parsed) == ["seed=1", "seed=2"]
    make.parsed("seed=3")
    assert list(make._parsed) == ["seed=3"]
    assert loader.loaded == []
    loader.load_configuration = lambda *given: pytest.fail("asked")  # type: ignore[method-assign,assignment]
    with pytest.raises(pytest.fail.Exception, match="asked"):
        make.parsed("seed=1,2")


def test_a_key_that_there_is_not_is_hydras_error() -> None:
    with pytest.raises(ConfigCompositionException):
        composer()(["sead=1"])
    make = composer()

    def refused(values: object, cfg: object) -> None:
        raise OmegaConfBaseException("in other words")

    make._apply = refused
    with pytest.raises(ConfigCompositionException) as told:
        make(["seed=1"])
    assert str(told.value.__cause__) == "in other words"


@pytest.mark.parametrize(
    ("lines", "alone"),
    [
        ([], True),
        (["a=1"], True),
        (["a=1", "b=text", "c=[1,2]", "d=null"], True),
        (["a.b=1", "a.c=2"], True),
        (["a.b=1", "ab=2"], True),
        (["a.b=1", "a=2"], False),
        (["a.b.c=1", "a=2"], False),
        (["a.b.c=1", "a.b=2"], False),
        (["+a=1"], False),
        (["~a"], False),
        (["++a=1"], False),
        (["a={b: 1}"], False),
        (["a=${b}"], False),
        (["b=1", "a=[1,'${b}']"], False),
    ],
)
def test_overrides_are_independent_where_none_is_above_another(lines: list[str], alone: bool) -> None:
    parsed = [parse_override(line) for line in lines]
    assert independent({one.key_or_group: one for one in parsed}) == alone


def test_an_override_knows_its_loader_and_is_not_nested_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    loader: Any = Loader()
    assert parse_override("a=1", loader).config_loader is loader

    def endless(lines: list[str]) -> None:
        raise RecursionError

    made = SimpleNamespace(create=lambda config_loader: SimpleNamespace(parse_overrides=endless))
    monkeypatch.setattr(composing, "OverridesParser", made)
    with pytest.raises(ValueError, match=r"^a=\[{38}\.\.\. is nested too deep\.$"):
        parse_override("a=" + "[" * 1000)


def test_interpolations_are_parsed_once_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = omegaconf.base
    asked: list[str] = []

    def parse(text: str) -> str:
        asked.append(text)
        return text

    monkeypatch.setattr(module, "parse", parse)
    with interpolations_parsed_once():
        assert [module.parse("a") for _ in range(3)] == ["a"] * 3
    assert asked == ["a"]
    assert module.parse is parse
    with pytest.raises(KeyError), interpolations_parsed_once():
        raise KeyError
    assert module.parse is parse
    monkeypatch.delattr(module, "parse")
    with interpolations_parsed_once():
        assert not hasattr(module, "parse")


# A sweep's loader


def master(*, searchpath: bool = False) -> Any:
    hydra = {"job": {"config_name": "config"}, "overrides": {"hydra": ["hydra.job.chdir=null"]}}
    return OmegaConf.create({"hydra": {**hydra, "searchpath": ["pkg://a"] if searchpath else []}})


@pytest.mark.skipif(HAS_WHITELIST, reason="Hydra 1.4 makes that name by a resolver")
def test_a_job_has_hydras_node_with_what_was_typed() -> None:
    make = composer()
    for lines in (["seed=1", "a.b=2"], ["seed=2", "a.b=2"], ["seed=2", "a.c=[1]"], ["seed=3"]):
        found = make.reused([*lines, "hydra.job.chdir=null"])
        assert found.hydra.overrides.task == lines
        kept = [line.replace("=", ":") for line in lines if "a.c" not in line]
        assert found.hydra.job.override_dirname == ";".join(sorted(kept))
        assert OmegaConf.is_readonly(found.hydra)


@pytest.mark.parametrize("searchpath", [False, True])
def test_a_sweep_composes_its_jobs_by_their_values(searchpath: bool) -> None:
    own: Any = Loader()
    of_sweep = master(searchpath=searchpath)
    context: Any = SimpleNamespace(config_loader=own)
    JobLoader.install(context, of_sweep)
    loader = context.config_loader
    assert isinstance(loader, JobLoader)
    JobLoader.install(context, of_sweep)
    assert context.config_loader is loader
    assert loader.extra() == "of Hydra"
    first = loader.load_sweep_config(of_sweep, ["seed=1"])
    assert values(first) == (1, 1, "own")
    again = loader.load_sweep_config(of_sweep, ["seed=2"])
    assert (again is first) == (not searchpath)
    settings = [loader.settings(of_sweep, [f"seed={seed}"]) for seed in (1, 2)]
    assert [cfg.seed for cfg in settings] == [1, 2]
    assert not any("hydra" in cfg for cfg in (first, *settings))
    whole = [loader.whole(of_sweep, [f"seed={seed}"], reuse=True) for seed in (1, 2)]
    assert (whole[0] is whole[1]) == (not searchpath)
    apart = [loader.whole(of_sweep, [f"seed={seed}"], reuse=False) for seed in (1, 2)]
    assert [cfg.seed for cfg in apart] == [1, 2]
    assert all("hydra" in cfg for cfg in (*whole, *apart))
    chosen = ("hydra.job.chdir=null", "kernel=x")
    assert loader.choices(of_sweep, ["kernel=x", "seed=1"]) == (None if searchpath else chosen)
    if not searchpath:
        assert own.loaded == [["hydra.job.chdir=null"]]  # for both, with Hydra's node and without


def test_what_was_looked_up_for_the_sweep_holds_for_its_jobs() -> None:
    called: list[int] = []
    register_resolver("staf_counted", lambda: called.append(1) or len(called), use_cache=True)
    try:
        of_sweep = master()
        of_sweep.at = "${staf_counted:}"
        assert of_sweep.at == 1
        loader: Any = JobLoader(Loader(at="${staf_counted:}"), of_sweep)  # type: ignore[arg-type]
        assert [loader.settings(of_sweep, [f"seed={seed}"]).at for seed in range(2)] == [1, 1]
        assert called == [1]
    finally:
        OmegaConf.clear_resolver("staf_counted")


# Members


def made(loader: Any, *members: list[str]) -> tuple[list[Any], list[Any]]:
    many = PlainComposer(composer(loader, hydra_node=False))([[*lines] for lines in members])
    return list(many.read()), list(many.flat)


def test_members_of_one_kind_are_composed_once_and_plain() -> None:
    loader = Loader()
    members = [["kernel=x", f"seed={n}", "a.c=[3]", f"a.b={n / 2}"] for n in range(4)]
    read, flat = made(loader, *members)
    assert all(isinstance(each, PlainSettings) for each in read)
    assert read == [{"seed": n, "a": {"b": n / 2, "c": [3]}, "kernel": "x"} for n in range(4)]
    assert flat == [{"seed": n, "a.b": n / 2, "a.c": [3], "kernel": "x"} for n in range(4)]
    assert loader.loaded == [["kernel=x"]]
    assert read[0]["a"] is not read[1]["a"]


@pytest.mark.parametrize(
    ("lines", "more", "plain"),
    [
        (["seed=1"], {}, True),
        (["seed=1"], {"x": "${seed}"}, False),
        (["seed=1"], {"x": {"y": ["${seed}"]}}, False),
        (["a.b=${seed}"], {}, False),
        (["a.b='a ???'"], {}, False),
        (["+b=1"], {}, False),
        (["a={b: 3}"], {}, False),
        (["a.c.0=5"], {}, False),  # an entry of a list has no place of its own
        (["a.b=2", "a=null"], {}, False),
        (["hydra.searchpath=[x]", "seed=1"], {}, False),
    ],
)
def test_members_that_refer_to_something_are_composed_by_hydra(
    lines: list[str], more: dict[str, Any], plain: bool
) -> None:
    loader = Loader(**more)
    expected = composer(Loader(**more), hydra_node=False)(lines)
    for read, flat in zip(*made(loader, lines, lines), strict=True):
        assert isinstance(read, PlainSettings) == plain
        assert read == OmegaConf.to_container(expected, resolve=True) or not plain
        assert flat["seed"] == expected.seed
        assert flat["kernel"] == "own"


def test_a_setting_that_is_missing_is_not_plain() -> None:
    read, flat = made(Loader(x="???"), ["seed=1"], ["seed=2"])
    assert not any(isinstance(each, PlainSettings) for each in read)
    assert [each["seed"] for each in flat] == [1, 2]


def test_lines_of_members_are_not_kept_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plain_composing, "MOST_LINES", 2)
    plain = PlainComposer(composer(hydra_node=False))
    plain([["seed=1"], ["seed=2"]])
    assert list(plain._lines) == ["seed=1", "seed=2"]
    plain([["seed=1"], ["seed=3"]])
    assert list(plain._lines) == ["seed=3"]


@pytest.mark.parametrize(
    ("key", "found"),
    [
        ("a", {"b": 1, "c": [2]}),
        ("a.b", 1),
        ("a.c", [2]),
        ("a.c.0", None),
        ("a.x", None),
        ("x.b", None),
        ("a.b.c", None),
    ],
)
def test_a_place_that_there_is_not_is_the_whole_tree(key: str, found: Any) -> None:
    tree = {"a": {"b": 1, "c": [2]}}
    assert plain_composing._at(tree, key) == (tree if found is None else found)

"""python -m tests.mutation: which wrong changes of the estimation and the centre do tests notice?

The tests are collected once. For each mutant the process forks; the child changes the code of one
function in memory, runs the tests of the module, the quickest first, and says which one failed.
A mutated kernel runs as plain Python, with the kernels that call it: a test that fails there
without the change too is not asked. Nothing is written into the source tree.

A mutant survives when its module's tests pass, or when none fails within the budget of CPU time.
"""

import argparse
import faulthandler
import json
import os
import random
import resource
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from _pytest.runner import runtestprotocol

from tests.mutation.change import changed
from tests.mutation.mutants import Mutant, mutants
from tests.mutation.table import MODULES

ROOT = Path(__file__).parents[2]
KILLED, SURVIVED, NOT_ASKED = "killed", "survived", "not asked"
ATTEMPTS = 5
"""Tests that a kernel as plain Python fails without a change too, before it is given up."""


def sample(module: str, count: int, seed: int) -> list[Mutant]:
    """So many mutants of a module: lines drawn at random, of each line one mutant."""
    by_line: dict[int, list[Mutant]] = {}
    for each in mutants((ROOT / module).read_bytes()):
        by_line.setdefault(each.line, []).append(each)
    draw = random.Random(f"{seed}:{module}")
    lines = draw.sample(sorted(by_line), min(count, len(by_line)))
    return [draw.choice(by_line[line]) for line in sorted(lines)]


class Mutation:
    """Runs each mutant instead of the tests themselves."""

    def __init__(self, chosen: Sequence[tuple[str, Mutant | None]], budget_s: float) -> None:
        self._chosen = chosen
        self._budget_s = budget_s
        self._seconds: dict[str, float] = {}
        self._unfit: dict[tuple[str, str], bool] = {}
        self.results: list[dict[str, Any]] = []

    @pytest.hookimpl(trylast=True)
    def pytest_collection(self) -> None:
        """Before the tests are imported: no example is written down, no failing one made small."""
        from hypothesis import Phase, settings  # pytest's plugin comes first

        phases = (Phase.explicit, Phase.generate)
        settings.register_profile("mutation", derandomize=True, database=None, phases=phases)
        settings.load_profile("mutation")

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """One mutant after the other."""
        for number, (module, mutant) in enumerate(self._chosen, 1):
            begun = time.monotonic()
            result = self._judged(session.items, module, mutant)
            self.results.append(result)
            took = time.monotonic() - begun
            sys.__stdout__.write(
                f"{number}/{len(self._chosen)} {result['verdict']:9} {module}:{mutant} "
                f"[{result.get('by', '')}] {took:.0f} s\n"
            )
            sys.__stdout__.flush()
        return True

    def _judged(
        self, items: Sequence[pytest.Item], module: str, mutant: Mutant | None
    ) -> dict[str, Any]:
        files = {str(ROOT / "tests" / name) for name in MODULES[module][1]}
        of_module = [each for each in items if str(each.path) in files]
        own = f"test_{Path(module).stem}"
        of_module.sort(
            key=lambda x: self._seconds.get(x.nodeid, 0.2 if x.path.stem == own else 1.0)
        )
        said = {"module": module, "mutant": str(mutant), "where": mutant.where if mutant else ""}
        for _ in range(ATTEMPTS):
            fit = [x for x in of_module if not self._unfit.get((str(said["where"]), x.nodeid))]
            found = self._run(fit, module, mutant, self._budget_s)
            failed = found.get("failed")
            if not found["begun"]:
                return said | {"verdict": NOT_ASKED, "by": found.get("error", "it did not begin")}
            if failed is None:
                return said | {
                    "verdict": SURVIVED, "by": found.get("error", ""), "ran": found["ran"]
                }  # fmt: skip
            key = (str(said["where"]), failed)
            if mutant is not None and found["kernel"] and key not in self._unfit:
                item = [each for each in fit if each.nodeid == failed]
                right = self._run(item, module, mutant._replace(new=mutant.old), self._budget_s)
                self._unfit[key] = right.get("failed") is not None
            if not self._unfit.get(key):
                return said | {"verdict": KILLED, "by": failed}
        return said | {"verdict": NOT_ASKED, "by": "its tests need the compiled kernel"}

    def _run(
        self, items: Sequence[pytest.Item], module: str, mutant: Mutant | None, budget_s: float
    ) -> dict[str, Any]:
        """What a child says that runs these tests with the change."""
        read, write = os.pipe()
        child = os.fork()
        if not child:
            os.close(read)
            _child(items, module, mutant, budget_s, self._seconds, write)
        os.close(write)
        found: dict[str, Any] = {"begun": False, "kernel": False, "ran": 0}
        running = None
        with os.fdopen(read) as lines:
            for line in lines:
                event = json.loads(line)
                running = event.get("runs", running)
                if "took" in event:
                    self._seconds[running] = event["took"]
                    found["ran"] += 1
                    running = None
                found.update({k: v for k, v in event.items() if k not in ("runs", "took")})
        os.waitpid(child, 0)
        if running is not None and "failed" not in found and "error" not in found:
            found["failed"] = running  # it died in this test, or never came to its end
        return found


def _child(
    items: Sequence[pytest.Item],
    module: str,
    mutant: Mutant | None,
    budget_s: float,
    seconds: dict[str, float],
    write: int,
) -> None:
    """Runs the tests until one fails or the CPU time is used up; never returns."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    faulthandler.disable()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def say(**event: object) -> None:
        os.write(write, (json.dumps(event) + "\n").encode())

    try:
        kernel = changed(ROOT / module, mutant) if mutant is not None else False
        say(begun=True, kernel=kernel)
        end = time.process_time() + budget_s
        for item, after in zip(items, [*items[1:], None], strict=True):
            usual = seconds.get(item.nodeid)
            # A known test that takes far longer hangs; an unknown one may be long.
            limit = budget_s if usual is None or kernel else 10.0 + 10.0 * usual
            signal.signal(signal.SIGPROF, signal.SIG_DFL)
            signal.setitimer(signal.ITIMER_PROF, limit)
            say(runs=item.nodeid)
            begun = time.process_time()
            reports = runtestprotocol(item, log=False, nextitem=after)
            if any(report.failed for report in reports):
                say(failed=item.nodeid)
                break
            say(took=time.process_time() - begun)
            if time.process_time() > end:
                say(error="budget")
                break
    except BaseException as error:
        say(error=f"{type(error).__name__}: {error}")
    os._exit(0)


def main() -> None:
    """Draws, judges, counts."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("modules", nargs="*", default=list(MODULES))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--share", type=float, default=1.0, help="of the sample of each module")
    parser.add_argument("--budget", type=float, default=20.0, help="CPU seconds of a mutant")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", action="append", help="mutants whose text has this, all of them")
    options = parser.parse_args()
    if unknown := [module for module in options.modules if module not in MODULES]:
        parser.error(f"{', '.join(unknown)} is not in tests/mutation/table.py: add its row there")
    chosen: list[tuple[str, Mutant | None]] = []
    for module in options.modules:
        count = max(1, round(options.share * MODULES[module][0]))
        drawn = sample(module, count, options.seed)
        if options.only:
            every = mutants((ROOT / module).read_bytes())
            drawn = [each for each in every if any(text in str(each) for text in options.only)]
        chosen += [(module, each) for each in drawn]
    files = sorted({name for module in options.modules for name in MODULES[module][1]})
    mutation = Mutation(chosen, options.budget)
    arguments = ["-q", "-n0", "-p", "no:cacheprovider", "-o", "faulthandler_timeout=0"]
    pytest.main([*arguments, *(f"{ROOT}/tests/{name}" for name in files)], plugins=[mutation])
    results = mutation.results
    print(f"\nseed {options.seed}, {len(results)} mutants")
    for module in options.modules:
        own = [each["verdict"] for each in results if each["module"] == module]
        if own:
            print(f"{own.count(KILLED):4} of {len(own) - own.count(NOT_ASKED):4} killed  {module}")
    verdicts = [each["verdict"] for each in results]
    asked = len(verdicts) - verdicts.count(NOT_ASKED)
    print(f"{verdicts.count(KILLED)} of {asked} killed, {verdicts.count(NOT_ASKED)} not asked")
    for each in results:
        if each["verdict"] == SURVIVED:
            print(f"survived  {each['module']}:{each['mutant']} {each['by']}")
    if options.json:
        options.json.write_text(json.dumps({"seed": options.seed, "results": results}, indent=1))


if __name__ == "__main__":
    main()

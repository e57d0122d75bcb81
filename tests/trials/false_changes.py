"""False alarms among landmarks that have not moved: many second days of `thesis-b` in memory.

    python -m tests.trials.false_changes [--maps 100]

Each map is of a first day; a second one joins it, every other without known starts. Prints the
number of landmarks reported as moved or gone, with the exact 95 % interval of the rate, and the
mean and exceedances of χ², which has two degrees of freedom. Ends with 1 if the interval is above
the stated rate.
"""

import argparse
import sys

import numpy as np

from teamslam.sim.in_memory.team import final_map
from teamslam.team.estimation.consistency import chi2_quantile
from teamslam.team.estimation.map_joining.saved_maps import FALSE_ALARM
from tests.central.test_saved_map import ALL, day

QUANTILES = (0.9, 0.99, 0.999)


def interval(count: int, of: int) -> tuple[float, float]:
    """95 % interval of a rare rate: the counts' mean is χ² of 2k and 2k + 2 degrees, halved."""
    low = 0.5 * float(chi2_quantile(0.025, 2 * count)) if count else 0.0
    return low / of, 0.5 * float(chi2_quantile(0.975, 2 * count + 2)) / of


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--maps", type=int, default=100)
    asked = parser.parse_args()
    chi2, false = list[float](), 0
    for number in range(asked.maps):
        _, centre, _ = day(5000 + number)
        saved = centre.maps.fold.save_map("site")
        samples, _, _ = day(6000 + number, [saved], unknown=ALL if number % 2 else ())
        changes = final_map(samples).changes
        chi2 += [each.chi2 for each in changes if each.state in {"unchanged", "moved"}]
        false += sum(each.state in {"moved", "gone"} for each in changes)
    values = np.array(chi2)
    low, high = interval(false, len(values))
    print(f"{false} of {len(values)} reported: rate {false / len(values):.4f}", end=" ")
    print(f"({low:.4f} to {high:.4f}), stated {FALSE_ALARM}; mean chi2 {values.mean():.2f}")
    for share in QUANTILES:
        beyond = float((values > chi2_quantile(share, 2)).mean())
        print(f"beyond the {share} quantile: {beyond:.4f}")
    return int(low > FALSE_ALARM)


if __name__ == "__main__":
    sys.exit(main())

"""Draw the log of a training run, or of several beside each other.

    python benchmarks/plot_log.py RUN/log.csv -o log.svg

Loss (its scale logarithmic) on the left, PSNR of the averaged weights on the right. Needs
matplotlib: pip install 'gsasr[plot]'.
"""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path


def read(path: Path) -> dict[str, list[tuple[int, float]]]:
    """Column -> (step, value) of the rows that have one."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    columns = [name for name in rows[0] if name == "loss" or name.startswith("psnr")]
    return {
        name: [(int(row["step"]), float(row[name])) for row in rows if row[name]]
        for name in columns
    }


def draw(paths: list[Path], output: Path) -> None:
    """Write the plot in the format of the output's suffix, the same bytes for the same log."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "gsasr"
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for path in paths:
        prefix = f"{path.parent.name} " if len(paths) > 1 else ""
        for name, points in read(path).items():
            if not points:
                continue
            axes = left if name == "loss" else right
            label = name.replace("psnr_", "")
            axes.plot(*zip(*points, strict=True), label=prefix + label, marker=".", markersize=3)
    left.set(xlabel="step", ylabel="L1 loss", yscale="log")
    left.yaxis.set_minor_formatter("{x:.2f}")
    right.set(xlabel="step", ylabel="PSNR on Y, dB")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        if axes.lines:
            axes.legend(frameon=False)
    figure.savefig(output, metadata={"Date": None} if output.suffix == ".svg" else None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("logs", type=Path, nargs="+", help="log.csv of a run")
    parser.add_argument("-o", "--output", type=Path, required=True, help=".svg or .png")
    options = parser.parse_args()
    try:
        draw(options.logs, options.output)
    except ImportError:
        sys.exit("plot_log: matplotlib is missing; pip install 'gsasr[plot]'.")


if __name__ == "__main__":
    main()

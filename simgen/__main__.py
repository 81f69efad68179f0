"""The command line: ``simgen render | validate | report | show | export | describe | doctor``."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from tyro.conf import Positional

from simgen import progress
from simgen.config import RenderOptions
from simgen.errors import UserError


@dataclass(frozen=True)
class ValidateOptions:
    """Checks a set with arithmetic of its own, reading nothing but the files.

    Exit status 1 if anything fails, with a list of what failed where.
    """

    folder: Positional[Path]
    """folder of a set, as simgen render makes it"""


@dataclass(frozen=True)
class ReportOptions:
    """Writes one self-contained HTML page about a set: contact sheet, distributions, timings."""

    folder: Positional[Path]
    """folder of a set, as simgen render makes it"""
    out: Path | None = None
    """the page; FOLDER/report.html if not given"""


@dataclass(frozen=True)
class ShowOptions:
    """Draws a frame as a PNG: images, depth, flow, status, the pair before and after rectifying."""

    folder: Positional[Path]
    """folder of a set, as simgen render makes it"""
    frame: int
    """frame index"""
    pair: int = 0
    """which pair of the rig"""
    out: Path | None = None
    """the picture; frame-<index>.png if not given"""


@dataclass(frozen=True)
class ExportOptions:
    """Writes one frame as OpenEXR (linear radiance rendered again, depth, flow, ids) and PNG."""

    folder: Positional[Path]
    """folder of a set, as simgen render makes it"""
    frame: int
    """frame index"""
    to: Path
    """folder for the files, made if needed"""


@dataclass(frozen=True)
class DescribeOptions:
    """Says what is in a set: frames, fields with shapes and units, conventions, config."""

    folder: Positional[Path]
    """folder of a set, as simgen render makes it"""


@dataclass(frozen=True)
class DoctorOptions:
    """Says what this machine renders with, and what would make it faster."""

    install_llvm: bool = False
    """install a usable LLVM through apt first, if there is none (needs root)"""


Command = (
    Annotated[RenderOptions, tyro.conf.subcommand("render")]
    | Annotated[ValidateOptions, tyro.conf.subcommand("validate")]
    | Annotated[ReportOptions, tyro.conf.subcommand("report")]
    | Annotated[ShowOptions, tyro.conf.subcommand("show")]
    | Annotated[ExportOptions, tyro.conf.subcommand("export")]
    | Annotated[DescribeOptions, tyro.conf.subcommand("describe")]
    | Annotated[DoctorOptions, tyro.conf.subcommand("doctor")]
)


def main(args: Sequence[str] | None = None) -> int:
    """Runs a command; returns the exit status."""
    try:
        try:
            return _run(args)
        finally:
            if sys.stdout:  # not closed by who started this
                sys.stdout.flush()  # at exit, it would be too late to catch what this raises
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


def _run(args: Sequence[str] | None) -> int:
    options: Any = tyro.cli(
        Command,
        prog="simgen",
        description="Road scenes for wide-baseline stereo, with exact ground truth.",
        args=args,
    )
    try:
        return _COMMANDS[type(options)](options)
    except UserError as error:
        print(f"simgen: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            "\nsimgen: stopped. Finished frames are kept; the same command goes on.",
            file=sys.stderr,
        )
        return 130


def _render(options: RenderOptions) -> int:
    from simgen.rendering import render

    return render(options)


def _validate(options: ValidateOptions) -> int:
    from simgen.validate import validate_folder

    with progress.bar(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("frames", total=None)
        report = validate_folder(
            options.folder, progress=lambda done, of: bar.update(task, completed=done, total=of)
        )
    print(report.table())
    return 0 if report.passed else 1


def _report(options: ReportOptions) -> int:
    from simgen.report import write_report

    page = write_report(options.folder, options.out or options.folder / "report.html")
    print(page)
    return 0


def _show(options: ShowOptions) -> int:
    from simgen.shards import ShardSet
    from simgen.show import save_picture

    frame = ShardSet(options.folder).frame(options.frame)
    print(save_picture(frame, options.pair, options.out or Path(f"frame-{options.frame}.png")))
    return 0


def _export(options: ExportOptions) -> int:
    from simgen.export import export_frame

    for path in export_frame(options.folder, options.frame, options.to):
        print(path)
    return 0


def _describe(options: DescribeOptions) -> int:
    from simgen.describe import describe

    print(describe(options.folder))
    return 0


def _doctor(options: DoctorOptions) -> int:
    from simgen import engine
    from simgen.doctor import diagnosis

    if options.install_llvm:
        print(engine.install_llvm())
    print(diagnosis())
    return 0


_COMMANDS: dict[type, Callable[[Any], int]] = {
    RenderOptions: _render,
    ValidateOptions: _validate,
    ReportOptions: _report,
    ShowOptions: _show,
    ExportOptions: _export,
    DescribeOptions: _describe,
    DoctorOptions: _doctor,
}

if __name__ == "__main__":
    sys.exit(main())

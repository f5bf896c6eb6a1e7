"""What the page on delivery says of sizes, errors and speed."""

from __future__ import annotations

from typing import Any

from tables import Row, Rows, cell, table

DELIVERY = "delivery_cpu.json"


@table("delivery_takes", DELIVERY)
def takes(result: Row) -> Rows:
    """Return the containers of a take: size, errors root mean square, relit loss, and time to decode a frame."""
    head = ["Gaussians", "error scale", "KB a frame", "moving", "position [mm]", "orientation", "normal", "occlusion"]
    decoders = {"NumPy [ms]": "numpy_ms", "Node.js [ms]": "node_ms", "Chromium [ms]": "chromium_ms"}
    rows: list[list[Any]] = [[*head, "relit [dB]", "loss [dB]", *decoders, "written [s a frame]"]]
    for row in result["takes"]["rows"]:
        errors = row["errors"]
        rows.append(
            [
                f"{row['gaussians']:,}",
                f"{row['factor']:g}",
                cell(row["kb_a_frame"], ".0f"),
                cell(row["moving_kb_a_frame"], ".0f"),
                cell(errors["position_mm"]["rms"], ".2f"),
                f"{cell(errors['turn_degrees']['rms'], '.2f')}°",
                f"{cell(errors['normal_degrees']['rms'], '.2f')}°",
                cell(errors["occlusion"]["rms"], ".3f"),
                cell(min(row["relit_psnr"].values()), ".1f"),
                cell(row["relit_loss_db"], ".2f"),
                *(_times(row[key]) for key in decoders.values()),
                cell(row["write_seconds_a_frame"], ".2f"),
            ]
        )
    return rows


def _times(found: Row | None) -> str:
    """Return a frame's part of playing a take, and the time of one frame by itself [ms]."""
    return "" if found is None else ", ".join(cell(found[what], ".1f") for what in ("all", "random"))


@table("delivery_codecs", DELIVERY)
def codecs(result: Row) -> Rows:
    """Return how small a segment becomes by each codec, and how long unpacking takes, a frame."""
    rows: list[list[Any]] = [["codec", "native in", "KB a frame", "unpacked [ms a frame]"]]
    for row in result["codecs"]["rows"]:
        rows.append([row["name"], row["native"], cell(row["kb_a_frame"], ".1f"), cell(row["ms"], ".2f")])
    return rows


@table("delivery_rates", "delivery_rates_cpu.json")
def rates(result: Row) -> Rows:
    """Return what takes of 24 frames lose against the truth at which size, as they are and reduced."""
    rows: list[list[Any]] = [["take", "its PSNR [dB]", "Gaussians", "error scale", "KB a frame", "loss [dB]"]]
    for name in ("figure", "walker"):
        found = result[name]
        for row in found["rows"]:
            cells = [cell(row["kb_a_frame"], ".0f"), cell(row["loss"], ".2f")]
            rows.append([name, cell(found["psnr"], ".1f"), f"{row['gaussians']:,}", f"{row['factor']:g}", *cells])
    return rows

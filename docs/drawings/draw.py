"""Drawings of the page "Your arm", from the model: `python docs/drawings/draw.py` in the checkout."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.drawing.render import Camera, Renderer
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.workspace import settle_many

HERE = Path(__file__).parent
ALONG_X = Camera(azimuth_deg=0.0, elevation_deg=0.0, height=1.5, centre=0.62)  # +y to the left, +z up
COLOURS = ("#e8442f", "#f2a92c", "#3f8fe0")  # of the sections' bellows
MOTIONS = (  # title, pressures [kPa] of chambers 0 to 8
    ("all 0 kPa", np.zeros(9)),
    ("all -40 kPa", np.full(9, -40.0)),
    ("all 20 kPa", np.full(9, 20.0)),
    ("chamber 0: 20 kPa", np.array([20.0, *np.zeros(8)])),
    ("chamber 6: 20 kPa", np.array([*np.zeros(6), 20.0, 0.0, 0.0])),
)


def main() -> None:
    """Write the drawings beside this file."""
    spec = ArmSpec.default()
    found = settle_many(spec, np.array([pressure_kpa for _, pressure_kpa in MOTIONS]))
    with Renderer(build_model(spec), width=480, height=800) as renderer:
        images = [renderer.draw(np.asarray(q), ALONG_X) for q in found.q]
    draw_parts(spec, images[0])
    draw_motions(images, 1e3 * np.asarray(found.tip_position_m))


def draw_parts(spec: ArmSpec, image: np.ndarray) -> None:
    """Draw the arm's parts from the side, and the numbers of chambers and springs from above."""
    figure, (side, above) = plt.subplots(1, 2, figsize=(9, 4.6), width_ratios=(1, 1.6), layout="constrained")
    # The rendered arm, its parts named beside it.
    side.imshow(image)
    side.axis("off")
    side.set_title("from the side, +y to the left")
    texts = (
        (0.05, "base, z = 0"),
        (0.19, "section 0: chambers 0, 1, 2"),
        (0.40, "section 1: chambers 3, 4, 5"),
        (0.61, "section 2: chambers 6, 7, 8"),
        (0.75, "centre of the last plate: the tip"),
        (0.82, "gripper"),
    )
    for share, text in texts:
        side.annotate(text, (1.0, 1.0 - share), xycoords="axes fraction", va="center")

    # A section's plate with chambers, springs and axes.
    params = ArmParams.from_spec(spec)
    above.add_patch(plt.Circle((0, 0), 1.2 * 1e3 * spec.geometry.spring_radius_m, fc="#ececf0", ec="#9090a0"))
    for k in range(3):
        x, y = 1e3 * params.chamber_site_m[0, k]
        above.add_patch(plt.Circle((x, y), 500 * spec.geometry.chamber_diameter_m, fc=COLOURS[0], alpha=0.75))
        above.text(x, y, f"{k}", ha="center", va="center", fontsize=16)
        x, y = 1e3 * params.spring_site_m[0, k]
        above.plot(x, y, "o", ms=9, mfc="white", mec="black")
        above.text(1.32 * x, 1.32 * y, f"spring {k}", ha="center", va="center")
    for axis, (x, y) in {"x": (1, 0), "y": (0, 1)}.items():
        start = np.array([-95, -95])
        above.annotate("", start + [28 * x, 28 * y], start, arrowprops={"arrowstyle": "->", "lw": 1.6})
        above.text(*(start + [34 * x, 34 * y]), axis, ha="center", va="center", fontsize=13, weight="bold")
    above.set(xlim=(-105, 105), ylim=(-105, 105), aspect="equal", xlabel="x [mm]", ylabel="y [mm]")
    above.set_title("a section, seen from above")
    figure.savefig(HERE / "parts.png", dpi=110)


def draw_motions(images: list[np.ndarray], tip_mm: np.ndarray) -> None:
    """Draw the arm at some pressures, with the tip's place."""
    figure, axes = plt.subplots(1, len(images), figsize=(11, 4.2), layout="constrained")
    for ax, image, (title, _), (_, y, z) in zip(axes, images, MOTIONS, tip_mm, strict=True):
        ax.imshow(image)
        ax.axis("off")
        ax.set_title(f"{title}\ntip at y {round(y) + 0:d}, z {z:.0f} mm", fontsize=10)
    figure.savefig(HERE / "motions.png", dpi=110)


if __name__ == "__main__":
    main()

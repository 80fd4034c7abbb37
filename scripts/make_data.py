"""Write the bundled scenes: `python scripts/make_data.py --out data_synthetic`.

Each scene is replaced whole; the same versions of numpy, OpenCV and pycolmap give the same arrays.
"""

import argparse
import contextlib
import shutil
import sqlite3
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm_shapefit.files.graph_text import graph_text
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.synthetic import (
    RenderOptions,
    SceneOptions,
    WorkspaceOptions,
    make_rendered_scene,
    make_scene,
    random_graph_problem,
)
from sfm_shapefit.synthetic.layouts import SceneCameras
from sfm_shapefit.synthetic.models import image_name
from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace
from sfm_shapefit.synthetic.workspace import write_workspace


class BundledScene(NamedTuple):
    """How a bundled scene is made, and what it is for."""

    purpose: str
    scene: SceneOptions
    workspace: WorkspaceOptions
    render: RenderOptions | None = None
    """How its images are drawn; None for made-up keypoints."""


SCENES = {
    "courtyard": BundledScene(
        purpose="A yard with four facades, photographed from inside. A quarter of the image pairs is wrong in"
        " a way that looks right, and 5 % of the matches of every pair are wrong. `sparse/0` knows the"
        " rotations only: all centers are at the origin and there are no points. `truth` is the exact model.",
        scene=SceneOptions(
            shape="courtyard",
            num_images=25,
            num_points=1500,
            pixel_noise_px=0.5,
            wrong_match_fraction=0.05,
            corrupted_pair_fraction=0.25,
            max_pairs_per_image=24,
            focal_length_px=720.0,
            seed=4,
        ),
        workspace=WorkspaceOptions(model="rotations"),
    ),
    "ring8": BundledScene(
        purpose="Eight cameras around a ball, without noise and without corruption: the answer is exact to"
        " the rounding of the database's 32-bit keypoints. `sparse/0` is the exact model.",
        scene=SceneOptions(
            shape="ring", num_images=8, num_points=1000, pixel_noise_px=0.0, min_matches=15, seed=8
        ),
        workspace=WorkspaceOptions(),
    ),
    "facade9": BundledScene(
        purpose="Nine cameras in a grid before a facade, 0.5 px noise. There is no database: the tracks of"
        " the exact model in `sparse/0` are the only source of directions.",
        scene=SceneOptions(shape="facade", num_images=9, num_points=400, pixel_noise_px=0.5, seed=9),
        workspace=WorkspaceOptions(database=False),
    ),
    "photographed": BundledScene(
        purpose="A yard drawn with its textures, through a lens with distortion; keypoints, matches and"
        " two-view geometries are those that COLMAP finds in the images. Some houses look the same, so that"
        " pairs of different ones are matched, verified and wrong. The images and the descriptors are left"
        " out here; the command below makes them. `sparse/0` knows the rotations only. `truth` is the exact"
        " model, its points joined along right matches.",
        scene=SceneOptions(
            shape="courtyard",
            num_images=16,
            max_keypoints_per_image=500,
            image_width=640,
            image_height=480,
            focal_length_px=480.0,
            seed=1,
        ),
        workspace=WorkspaceOptions(model="rotations"),
        render=RenderOptions(repeated_fraction=0.2),
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the scenes")
    out = parser.parse_args().out
    for name, text in TABLES.items():
        (out / name).write_text(text(), encoding="utf-8")
    for name in SCENES:
        write_scene(name, out / name)
        size_kb = sum(file.stat().st_size for file in (out / name).rglob("*") if file.is_file()) / 1e3
        print(f"{out / name}: {size_kb:.0f} kB")


def bundled_graph_text() -> str:
    """Return the bundled bare graph, of the paper's random model: n = 40, p = 1/2, q = 0.2, sigma = 0.01."""
    problem = random_graph_problem(40, 0.5, sigma=0.01, q=0.2, seed=40)
    header = (
        "# i j vx vy vz: unit directions of t_i - t_j, a fifth of them wrong; python scripts/make_data.py\n"
    )
    return header + graph_text(ViewGraph(40, problem.edges, problem.directions))


def measured_positions_text() -> str:
    """Return positions of the courtyard's cameras as GPS would give them: 5 cm off, and one of them 30 m."""
    scene = make_scene(SCENES["courtyard"].scene)
    noise = 0.05 * np.random.default_rng(0).standard_normal(scene.centers.shape)
    measured = scene.centers + noise
    measured[:, 0] += 100.0
    measured[3, 0] += 30.0
    lines = [
        f"{image_name(k)},{x:.3f},{y:.3f},{z:.3f},0.05\n" for k, (x, y, z) in enumerate(measured.tolist())
    ]
    return "name,x,y,z,sigma\n" + "".join(lines)


def control_points_text() -> str:
    """Return ground control points of the courtyard, 1 cm off: one of them 2 m too high, two to check."""
    scene = make_scene(SCENES["courtyard"].scene)
    seen = np.bincount(np.concatenate([own[own >= 0] for own in scene.keypoint_points]))
    chosen = [int(np.argmax(seen))]
    for _ in range(8):  # always the farthest from all that are chosen, of those in many images
        apart = scene.points[: len(seen), None] - scene.points[chosen]
        chosen.append(int(np.argmax(np.where(seen >= 6, np.linalg.norm(apart, axis=2).min(axis=1), 0.0))))
    noise = 0.01 * np.random.default_rng(0).standard_normal((len(chosen), 3))
    measured = scene.points[chosen] + noise + [100.0, 0.0, 0.0]
    measured[3, 2] += 2.0
    lines = ["local\n"]
    for k, (x, y, z) in enumerate(measured.tolist()):
        name = f"P{k + 1}" if k < 7 else f"CHK-{k - 6}"
        lines += [f"{x:.3f} {y:.3f} {z:.3f} {mark} {name}\n" for mark in marks_of(scene, chosen[k])]
    return "".join(lines)


def marks_of(scene: SceneCameras, point: int) -> list[str]:
    """Return pixels and image of about five of the keypoints that see a point."""
    seen = zip(scene.keypoints, scene.keypoint_points, strict=True)
    marks = [
        f"{pixels[points == point][0, 0]:.1f} {pixels[points == point][0, 1]:.1f} {image_name(image)}"
        for image, (pixels, points) in enumerate(seen)
        if (points == point).any()
    ]
    return marks[:: len(marks) // 5]


def scale_bars_text() -> str:
    """Return four scale bars of the courtyard, known to 2 mm, one of them to check."""
    scene = make_scene(SCENES["courtyard"].scene)
    seen = np.bincount(np.concatenate([own[own >= 0] for own in scene.keypoint_points]))
    chosen, rng = np.argsort(-seen, kind="stable")[:80:10].reshape(4, 2), np.random.default_rng(0)
    lines = ["# length, its standard deviation, pixels, image, name of the bar, and which end it is\n"]
    for name, ends in zip(("B1", "B2", "B3", "CHK-1"), chosen.tolist(), strict=True):
        length = np.linalg.norm(scene.points[ends[0]] - scene.points[ends[1]]) + 0.002 * rng.standard_normal()
        for end, point in zip(("left", "right"), ends, strict=True):
            lines += [f"{length:.4f} 0.002 {mark} {name} {end}\n" for mark in marks_of(scene, point)]
    return "".join(lines)


def gravity_text() -> str:
    """Return the gravity of the cameras of ring8, 1 degree off per axis, and one of them wrong."""
    scene = make_scene(SCENES["ring8"].scene)
    measured = -scene.rotations[:, :, 2] + np.radians(1.0) * np.random.default_rng(0).standard_normal((8, 3))
    measured[5] = [1.0, 0.0, 0.0]
    lines = [f"{image_name(k)} {x:.4f} {y:.4f} {z:.4f}\n" for k, (x, y, z) in enumerate(measured.tolist())]
    return "# name, gravity in axes of the camera\n" + "".join(lines)


def names_text() -> str:
    """Return the names of four images of ring8, as a file for --fix."""
    return "".join(f"{image_name(k)}\n" for k in range(4))


def across_text() -> str:
    """Return the pairs between the halves of ring8, as a file for --without: two models are left."""
    return "".join(f"{image_name(i)},{image_name(j)}\n" for i in range(4) for j in range(4, 8))


TABLES = {
    "graph40.txt": bundled_graph_text,
    "gps.csv": measured_positions_text,
    "gcp_list.txt": control_points_text,
    "scale_bars.txt": scale_bars_text,
    "gravity.txt": gravity_text,
    "names.txt": names_text,
    "across.txt": across_text,
}
"""Files beside the scenes, and what writes each."""


def write_scene(name: str, folder: Path) -> None:
    """Write one bundled scene with its SOURCE.md, in place of what stands there."""
    if folder.exists():
        shutil.rmtree(folder)
    bundled = SCENES[name]
    if bundled.render is None:
        write_workspace(make_scene(bundled.scene), folder, bundled.workspace)
    else:
        write_rendered_workspace(
            make_rendered_scene(bundled.scene, bundled.render), folder, bundled.workspace
        )
        shutil.rmtree(folder / "images")
        # Only matching needs the descriptors, most of the database's size.
        with contextlib.closing(sqlite3.connect(folder / "database.db", isolation_level=None)) as connection:
            connection.execute("DELETE FROM descriptors")
            connection.execute("VACUUM")
    (folder / "SOURCE.md").write_text(source_text(name), encoding="utf-8")


def source_text(name: str) -> str:
    """Return what SOURCE.md says: what the scene is, and the commands that make it."""
    bundled = SCENES[name]
    flags = _list_flags(bundled.scene) + _list_flags(bundled.workspace)
    if bundled.render is not None:
        flags += ["--images", *_list_flags(bundled.render)]
    return (
        f"# {name}\n\n{bundled.purpose}\n\n"
        f"Synthetic, seed {bundled.scene.seed}. Made, with the other scenes, by\n\n"
        f"    python scripts/make_data.py --out data_synthetic\n\nand alone by\n\n"
        f"    sfm-shapefit synth {name} {' '.join(flags)}\n"
    )


def _list_flags(options: SceneOptions | WorkspaceOptions | RenderOptions) -> list[str]:
    """Return the command-line flags of the options that differ from their defaults."""
    default = type(options)()
    flags = []
    for field in fields(options):
        value = getattr(options, field.name)
        flag = field.name.replace("_", "-")
        if value == getattr(default, field.name):
            continue
        if isinstance(value, bool):
            flags.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            flags.append(f"--{flag} {value}")
    return flags


if __name__ == "__main__":
    main()

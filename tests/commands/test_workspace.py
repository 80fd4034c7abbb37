"""What `workspace` writes, read as the programs that it is for read it.

The pictures show a sky: each pixel has the color of its direction in the world, so that every picture that is
written can be compared with the pose and the camera that were written with it.
"""

import json
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import sfm_shapefit
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import angle_between_deg
from sfm_shapefit.files.undistortion_options import UndistortionOptions
from tests.program import run, run_refused

SKY_DISTANCE = 20.0
LENSES = {
    "pinhole": ("PINHOLE", 160, 120, [110.0, 110.0, 80.0, 60.0]),
    "aside": ("PINHOLE", 160, 120, [110.0, 110.0, 70.0, 66.0]),
    "radial": ("SIMPLE_RADIAL", 160, 120, [110.0, 80.0, 60.0, -0.15]),
    "fisheye": (
        "OPENCV_FISHEYE",
        240,
        180,
        [92.0, 92.0, 120.0, 90.0, 0.01, 0.0, 0.0, 0.0],
    ),  # 75 deg to the side
    "circle": ("OPENCV_FISHEYE", 200, 200, [60.0, 60.0, 100.0, 100.0, 0.0, 0.0, 0.0, 0.0]),  # 95 deg
    "panorama": ("EQUIRECTANGULAR", 320, 160, [320.0, 160.0]),
}
FACES = {"fisheye": 2, "circle": 4, "panorama": 6}
UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # cam_from_world, z of the world up


class Sky(NamedTuple):
    model: pycolmap.Reconstruction
    images: Path


def color_of(directions):
    return 127.5 + 110.0 * directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def draw_sky(tmp_path, lenses, turn=None, roll_deg=0.0, num_frames=4, seed=0):
    """Return a model of frames whose sensors look through some lenses, each turned from the one before."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=seed).as_matrix() if turn is None else turn
    model, rig, cameras = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1), []
    for k, lens in enumerate(lenses):
        name, width, height, params = LENSES[lens]
        cameras.append(
            pycolmap.Camera(model=name, width=width, height=height, params=params, camera_id=k + 1)
        )
        model.add_camera(cameras[-1])
        aside = Rotation.from_euler("y", 150 * k, degrees=True).as_matrix()
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(aside), np.full(3, 0.1 * k))
        rig.add_sensor(cameras[-1].sensor_id, pose) if k else rig.add_ref_sensor(cameras[-1].sensor_id)
    model.add_rig(rig)
    sky = rng.normal(size=(600, 3))
    sky *= SKY_DISTANCE / np.linalg.norm(sky, axis=1, keepdims=True)
    sky[::3, 2] = -1.5  # the ground
    tracks = [pycolmap.Track() for _ in sky]
    for f in range(num_frames):
        frame, own = pycolmap.Frame(frame_id=f + 1, rig_id=1), []
        level = UPRIGHT @ Rotation.from_euler("z", 25.0 * f, degrees=True).as_matrix().T
        rolled = Rotation.from_euler("z", roll_deg * rng.normal(), degrees=True).as_matrix() @ level
        center = np.array([*rng.uniform(-1, 1, 2), 0.2 * rng.normal()])
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(rolled @ turn.T), -rolled @ center)
        for k, camera in enumerate(cameras):
            image_id = f * len(cameras) + k + 1
            pose = (
                pycolmap.Rigid3d() if k == 0 else rig.sensor_from_rig(camera.sensor_id)
            ) * frame.rig_from_world
            there = pose * (sky @ turn.T)
            with np.errstate(invalid="ignore"):
                xy = camera.img_from_cam(there, check_cheirality=not camera.is_spherical())
                back = camera.cam_ray_from_img(np.nan_to_num(xy))
                seen = (angle_between_deg(back, there / np.linalg.norm(there, axis=1)[:, None]) < 1e-3) & (
                    (xy > 0.5) & (xy < [camera.width - 0.5, camera.height - 0.5])
                ).all(axis=1)
            name = f"cam{k}/{f}.png" if len(cameras) > 1 else f"{f}.png"
            for row, point in enumerate(np.flatnonzero(seen)):
                tracks[point].add_element(image_id, row)
            image = pycolmap.Image(name=name, keypoints=xy[seen], camera_id=k + 1, image_id=image_id)
            image.frame_id = f + 1
            frame.add_data_id(image.data_id)
            own.append(image)
            x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
            rays = camera.cam_ray_from_img(np.stack([x.ravel(), y.ravel()], axis=1))
            pixels = np.nan_to_num(color_of(rays @ pose.rotation.matrix())).reshape(*x.shape, 3)
            file = tmp_path / "images" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(file), np.rint(pixels[..., ::-1]).astype(np.uint8))
        model.add_frame(frame)
        for image in own:
            model.add_image(image)
        model.register_frame(f + 1)
    for xyz, track in zip(sky @ turn.T, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(xyz, track)
    model.update_point_3d_errors()
    return Sky(model, tmp_path / "images")


def read_as_3dgs(folder):
    """Yield picture, rotation and focal lengths of each image as 3DGS takes them."""
    model = pycolmap.Reconstruction(folder / "sparse/0")
    for image in model.images.values():
        camera = model.camera(image.camera_id)
        assert camera.model_name in ("SIMPLE_PINHOLE", "PINHOLE")
        picture = cv2.imread(str(folder / "images" / Path(image.name).name))
        assert picture.shape == (camera.height, camera.width, 3)
        yield picture[..., ::-1], image.cam_from_world().rotation.matrix(), camera.params[:2]


def off_the_sky(picture, rotation, focal_lengths):
    """Return by how much, in levels of 255, pixels differ from the sky: the median, and all but a twentieth.

    The principal point is taken to be in the middle, as 3DGS does.
    """
    height, width = picture.shape[:2]
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x / focal_lengths[0], y / focal_lengths[1], np.ones_like(x)], axis=-1)
    off = np.abs(picture - color_of(rays @ rotation)).max(axis=-1)
    return np.median(off), np.quantile(off, 0.95)


@pytest.mark.parametrize("lens", LENSES)
def test_pictures_show_what_their_cameras_see(tmp_path, lens):
    sky = draw_sky(tmp_path, [lens])
    made = sfm_shapefit.workspace(sky.model, sky.images, tmp_path / "out", level="never")
    assert not made.warnings
    views = list(read_as_3dgs(tmp_path / "out"))
    assert len(views) == 4 * FACES.get(lens, 1)
    # Levels are rounded, by at most 0.5, and interpolated: the sky is smooth, but at the poles of a panorama,
    # and beyond 90 degrees of a fisheye, where pycolmap has no rays by which the sky could be drawn.
    medians, most = zip(*(off_the_sky(*view) for view in views), strict=True)
    assert max(medians) <= 1.0
    assert max(most) <= 2.5


@pytest.mark.parametrize("lens", ["pinhole", "radial", "panorama"])
def test_pictures_are_made_smaller_where_that_is_wanted(tmp_path, lens):
    sky = draw_sky(tmp_path, [lens], num_frames=2)
    sfm_shapefit.workspace(sky.model, sky.images, tmp_path / "out", level="never", max_image_size=61)
    views = list(read_as_3dgs(tmp_path / "out"))
    assert {max(picture.shape[:2]) for picture, *_ in views} == {61}
    # As above; the mean over a smaller pixel differs from its middle by less than a level.
    assert max(np.median(off_the_sky(*view)) for view in views) <= 1.5
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert max(point.error for point in model.points3D.values()) < 1e-3


@pytest.mark.parametrize(
    ("lens", "longest_px"), [("pinhole", -1), ("radial", -1), ("fisheye", 80), ("panorama", -1)]
)
def test_masks_go_the_way_of_their_pictures(tmp_path, lens, longest_px):
    """Masked is the half of the sky that is less green, but in the first image, which has no mask."""
    sky = draw_sky(tmp_path, [lens, lens], num_frames=2)
    for name in ("cam0/1.png", "cam1/0.png", "cam1/1.png"):
        picture = cv2.imread(str(sky.images / name))
        file = tmp_path / f"masks/{name}.png" if name != "cam1/1.png" else tmp_path / "masks" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), (picture[..., 1] > 127).astype(np.uint8))  # to COLMAP, 1 is as good as 255
    out, options = tmp_path / "out", {"mask_path": str(tmp_path / "masks"), "max_image_size": longest_px}
    sfm_shapefit.workspace(sky.model, sky.images, out, options=UndistortionOptions(**options))
    frames = json.loads((out / "transforms.json").read_text())["frames"]
    assert {path.name for path in (out / "masks").iterdir()} == {
        f"{path.name}.png" for path in (out / "images").iterdir()
    }
    assert len(frames) == 4 * FACES.get(lens, 1)  # nerfstudio wants a mask of each or of none
    for frame in frames:
        assert frame["mask_path"] == f"masks/{Path(frame['file_path']).name}.png"
        mask = cv2.imread(str(out / frame["mask_path"]), cv2.IMREAD_UNCHANGED)
        picture = cv2.imread(str(out / frame["file_path"]))
        assert mask.shape == picture.shape[:2]
        assert set(np.unique(mask)) <= {0, 255}
        is_first = Path(frame["file_path"]).name.startswith("cam0_0")
        clear = np.abs(picture[..., 1] - 127.0) > 6.0  # farther from the edge of the mask than two pixels
        wanted = np.ones_like(clear) if is_first else picture[..., 1] > 127
        assert np.mean((mask > 0)[clear] == wanted[clear]) > 0.995  # the border of the picture aside


def test_masks_that_are_none_or_of_another_size_are_told(tmp_path):
    sky, masks = draw_sky(tmp_path, ["pinhole"]), tmp_path / "masks"
    masks.mkdir()
    sky.model.write(tmp_path / "images")
    typed = ("workspace", tmp_path / "images", sky.images, tmp_path / "out", "--mask_path", masks)
    assert "has no mask of the 4 images; that of 0.png is to be 0.png.png" in run_refused(*typed)
    cv2.imwrite(str(masks / "0.png"), np.zeros((120, 160), np.uint8))
    cv2.imwrite(str(masks / "1.png.png"), np.zeros((60, 80), np.uint8))
    (masks / "2.png").write_text("no picture")
    (masks / "3.png.png").symlink_to("3.png.png")  # round in a circle; as if there were none
    said = run(*typed, code=0).stdout
    assert "1 image is left out (mask of another size than its camera's): 1.png" in said
    assert "1 image is left out (unreadable mask): 2.png" in said
    assert not cv2.imread(str(tmp_path / "out/masks/0.png.png")).any()
    assert cv2.imread(str(tmp_path / "out/masks/3.png.png")).all()


@pytest.mark.parametrize("lenses", [["panorama"], ["circle"], ["circle", "circle"], ["radial", "fisheye"]])
def test_faces_are_rigs_and_points_stay_where_they_are(tmp_path, lenses):
    sky = draw_sky(tmp_path, lenses)
    sfm_shapefit.workspace(sky.model, sky.images, tmp_path / "out", level="never")
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    (rig,) = model.rigs.values()
    assert rig.num_sensors() == sum(FACES.get(lens, 1) for lens in lenses)
    assert model.num_reg_frames() == 4
    assert model.num_points3D() > 0.6 * sky.model.num_points3D()
    for point_id, point in model.points3D.items():
        np.testing.assert_array_equal(point.xyz, sky.model.point3D(point_id).xyz)
        assert point.error < 1e-3
    names = [image.name for image in model.images.values()]
    assert not any("/" in name for name in names)
    for image in model.images.values():
        for _, before in sky.model.images.items():
            if before.frame_id == image.frame_id and image.name.startswith(
                before.name.replace("/", "_")[:-4]
            ):
                np.testing.assert_allclose(image.projection_center(), before.projection_center(), atol=1e-12)


def test_every_program_finds_its_files(tmp_path):
    sky = draw_sky(tmp_path, ["radial"], roll_deg=2.0)
    out = tmp_path / "out"
    made = sfm_shapefit.workspace(sky.model, sky.images, out, level="never")
    dense = pycolmap.Reconstruction(out / "sparse")  # COLMAP's dense commands, OpenMVS
    assert dense.num_reg_images() == made.reconstruction.num_reg_images() == 4
    names = sorted(image.name for image in dense.images.values())
    assert (out / "stereo/fusion.cfg").read_text().split() == names
    assert (out / "stereo/patch-match.cfg").read_text().split("\n")[:2] == [names[0], "__auto__, 20"]
    cloud = trimesh.load(out / "sparse/0/points3D.ply")
    header = (out / "sparse/0/points3D.ply").read_bytes().split(b"end_header")[0].decode().split()
    assert {"nx", "ny", "nz"} <= {*header}  # without which 3DGS fails
    points = sorted(dense.points3D.items())
    np.testing.assert_allclose(cloud.vertices, [point.xyz for _, point in points], rtol=1e-6)
    np.testing.assert_array_equal(cloud.colors[:, :3], [point.color for _, point in points])
    # Cameras are up to 1.5 from the origin, and these points 20: no color is of a place over 0.08 rad away.
    seen = np.array([point.xyz for _, point in points])
    far = np.linalg.norm(seen, axis=1) > 19.0
    assert np.abs(cloud.colors[far, :3] - color_of(seen[far])).max() < 110.0 * 0.08
    transforms = json.loads((out / "transforms.json").read_text())
    assert (out / transforms["ply_file_path"]).is_file()
    again = sfm_shapefit.evaluate(out / "transforms.json", out / "sparse/0")
    assert again.position.max < 1e-9
    assert again.rotation_deg.max < 1e-6
    for frame in transforms["frames"]:
        assert (out / frame["file_path"]).is_file()


@pytest.mark.parametrize("seed", range(3))
def test_the_ground_is_leveled_as_surely_as_it_says(tmp_path, seed):
    turn = Rotation.random(random_state=10 + seed).as_matrix()
    sky = draw_sky(tmp_path, ["pinhole"], turn, roll_deg=2.0, num_frames=12, seed=seed)
    made = sfm_shapefit.workspace(sky.model, sky.images, tmp_path / "out")
    assert made.level.startswith("leveled, z points up; up is known to ")
    sigma_deg = float(made.level.split("known to ")[1].split()[0])
    before, after = (model.image(1).cam_from_world() for model in (sky.model, made.reconstruction))
    up = after.rotation.matrix().T @ before.rotation.matrix() @ turn[:, 2]
    off_deg = float(angle_between_deg(up, np.array([0.0, 0.0, 1.0])))
    assert off_deg < 4.0 * sigma_deg  # of two angles, beyond by chance in 3 of 10,000
    assert 0.05 < sigma_deg < 1.5


def test_what_is_level_keeps_its_axes_and_so_does_what_is_not_to_be_leveled(tmp_path):
    sky = draw_sky(tmp_path, ["pinhole"], np.eye(3), roll_deg=1.0, num_frames=8)
    made = sfm_shapefit.workspace(sky.model, sky.images, tmp_path / "out")
    assert made.level.startswith("z points up already, within ")
    turned = draw_sky(tmp_path / "turned", ["pinhole"], roll_deg=1.0, num_frames=8)
    kept = sfm_shapefit.workspace(turned.model, turned.images, tmp_path / "kept", level="never")
    assert kept.level == "its axes stay, as asked"
    for k, point in kept.reconstruction.points3D.items():
        np.testing.assert_array_equal(point.xyz, turned.model.point3D(k).xyz)


def test_a_model_placed_on_earth_keeps_its_axes(tmp_path):
    sky = draw_sky(tmp_path, ["pinhole"])
    (tmp_path / "model").mkdir()
    sky.model.write(tmp_path / "model")
    datum = {"latitude_deg": 48.0, "longitude_deg": 11.0, "altitude_m": 500.0}
    (tmp_path / "model/locate.json").write_text(json.dumps({"datum": datum}))
    made = sfm_shapefit.workspace(tmp_path / "model", sky.images, tmp_path / "out")
    assert made.level == "its axes are those of its priors: east, north, up"
    for k, point in made.reconstruction.points3D.items():
        np.testing.assert_array_equal(point.xyz, sky.model.point3D(k).xyz)


def test_a_model_far_from_its_origin_is_written_near_it_and_the_offset_is_told(tmp_path):
    """UTM: float32 has steps of half a meter there, in a scene of 40 m."""
    utm = np.array([690006.296, 5330000.243, 523.4])
    sky = draw_sky(tmp_path, ["radial"], np.eye(3), roll_deg=1.0)
    centers = {image.name: image.projection_center() for image in sky.model.images.values()}
    points = {k: point.xyz.copy() for k, point in sky.model.points3D.items()}
    sky.model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), utm))
    (tmp_path / "model").mkdir()
    sky.model.write(tmp_path / "model")
    out = tmp_path / "out"
    said = run("workspace", tmp_path / "model", sky.images, out, code=0).stdout
    offset = np.array([float(word) for word in (out / "offset.xyz").read_text().split()])
    np.testing.assert_array_equal(offset, [690000.0, 5330000.0, 500.0])
    assert "offset: 690000.0 5330000.0 500.0, subtracted from all coordinates, see offset.xyz" in said
    made = pycolmap.Reconstruction(out / "sparse/0")
    for image in made.images.values():
        np.testing.assert_allclose(image.projection_center() + offset, centers[image.name] + utm, atol=1e-6)
    assert b"property float x" in (out / "sparse/0/points3D.ply").read_bytes()
    xyz = [points[k] + (utm - offset) for k in sorted(made.points3D)]
    np.testing.assert_allclose(trimesh.load(out / "sparse/0/points3D.ply").vertices, xyz, atol=1e-5)
    for frame in json.loads((out / "transforms.json").read_text())["frames"]:
        center = made.find_image_with_name(Path(frame["file_path"]).name).projection_center()
        np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3, 3], center, atol=1e-9)
    kept = sfm_shapefit.workspace(tmp_path / "model", sky.images, tmp_path / "kept", offset="0,0,0")
    np.testing.assert_allclose(
        kept.reconstruction.point3D(min(points)).xyz, sky.model.point3D(min(points)).xyz
    )
    assert not (tmp_path / "kept/offset.xyz").exists()
    with pytest.raises(InputError, match="the offset must be auto, or three numbers"):
        sfm_shapefit.workspace(tmp_path / "model", sky.images, tmp_path / "no", offset="far")
    nerf = tmp_path / "t.json"
    assert "float32; give --offset auto" in run("convert", tmp_path / "model", nerf, code=0).stdout


def test_an_offset_is_near_enough_for_a_small_scene(tmp_path):
    sky = draw_sky(tmp_path, ["pinhole"], np.eye(3))
    sky.model.transform(pycolmap.Sim3d(1e-3, pycolmap.Rotation3d(), np.array([10.0, -20.049, 0.0])))
    made = sfm_shapefit.workspace(sky.model, sky.images, tmp_path / "out")
    assert b"property float x" in (tmp_path / "out/sparse/0/points3D.ply").read_bytes()
    assert made.offset[0] == pytest.approx(10.0, abs=0.05)
    assert made.offset[1] == pytest.approx(-20.049, abs=0.05)


def test_pictures_of_several_folders_are_one_folder_of_pictures_that_can_be_written(tmp_path):
    sky = draw_sky(tmp_path, ["pinhole"], num_frames=3)
    (sky.images / "a").mkdir()
    for image_id, name in enumerate(("a/b.png", "a_b.png", "c.webp"), start=1):
        (sky.images / sky.model.image(image_id).name).rename(sky.images / name)
        sky.model.images[image_id].name = name
    made = sfm_shapefit.workspace(sky.model, sky.images, tmp_path / "out", level="never")
    assert made.told[1] == "pictures: a/b.png becomes images/a_b.png"
    written = {path.name for path in (tmp_path / "out/images").iterdir()}
    assert written == {"a_b.png", "a_b_.png", "c.png"}
    assert len(list(read_as_3dgs(tmp_path / "out"))) == 3


def test_the_verdict_of_a_model_that_is_not_good_is_said_again(tmp_path):
    sky = draw_sky(tmp_path, ["pinhole"])
    sky.model.write(tmp_path / "images")  # any folder that exists
    for name, statement in {"bad": "do not use: 5 of 16 cameras stand apart", "good": "good"}.items():
        (tmp_path / "images/locate.json").write_text(json.dumps({"verdict": {"statement": statement}}))
        made = sfm_shapefit.workspace(tmp_path / "images", sky.images, tmp_path / name)
        said = [one for one in made.warnings if "verdict" in one]
        assert said == ([f"the verdict on the model is: {statement}"] if name == "bad" else [])


def test_pictures_that_are_missing_or_broken_are_named_and_left_out(tmp_path):
    sky = draw_sky(tmp_path, ["radial"])
    (sky.images / "0.png").unlink()
    (sky.images / "1.png").write_text("no picture")
    sky.model.write(tmp_path / "images")  # any folder that exists
    done = run("workspace", tmp_path / "images", sky.images, tmp_path / "out")
    said = done.stdout + done.stderr
    assert done.exit_code == 0, said
    assert "warning: 1 image is left out (not found): 0.png" in said
    assert said.splitlines()[-1].startswith("next: ")
    assert "warning: 1 image is left out (unreadable picture): 1.png" in said
    names = {image.name for image in pycolmap.Reconstruction(tmp_path / "out/sparse/0").images.values()}
    assert names == {path.name for path in (tmp_path / "out/images").iterdir()} == {"2.png", "3.png"}


def test_a_broken_picture_prints_no_lines_of_the_library_that_reads_it(tmp_path, capfd):
    sky = draw_sky(tmp_path, ["pinhole"])
    whole = (sky.images / "1.png").read_bytes()
    (sky.images / "1.png").write_bytes(whole[: len(whole) // 2])
    sfm_shapefit.workspace(sky.model, sky.images, tmp_path / "out")
    assert capfd.readouterr().err == ""


def test_a_wrong_folder_or_small_pictures_are_refused_and_nothing_is_written(tmp_path):
    sky = draw_sky(tmp_path, ["pinhole"], num_frames=2)
    (tmp_path / "empty").mkdir()
    refused = r"has none of the model's images \(0.png: not found\); give the folder"
    with pytest.raises(InputError, match=refused):
        sfm_shapefit.workspace(sky.model, tmp_path / "empty", tmp_path / "out")
    for file in sky.images.iterdir():
        cv2.imwrite(str(file), cv2.imread(str(file))[::2, ::2])
    with pytest.raises(InputError, match="picture of another size than its camera's"):
        sfm_shapefit.workspace(sky.model, sky.images, tmp_path / "out")
    with pytest.raises(InputError, match="give the folder of those that it was made of, and their masks"):
        sfm_shapefit.workspace(sky.model, sky.images, tmp_path / "out", mask_path=str(sky.images))
    sky.model.camera(1).width = sky.model.camera(1).height = 0
    with pytest.raises(InputError, match="camera 1 is of 0 x 0 pixels; give it the size of its pictures"):
        sfm_shapefit.workspace(sky.model, sky.images, tmp_path / "out")
    assert not (tmp_path / "out").exists()

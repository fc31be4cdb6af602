"""The overlay: projection, drawing and the video file."""

import dataclasses
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from pbl_pipeline.body import capsules, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit, fit_session
from pbl_pipeline.gait import GaitEvent, angle_series
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.render import (
    NEAR_M,
    SIDE_COLOUR,
    body_track,
    capsule_outline,
    draw_body,
    draw_keypoints,
    overlay_frames,
    render_overlay,
    report_indices,
    rotation_matrix,
    side_of,
    stance_spans,
    to_camera,
    to_pixels,
    uncertain_sides,
)
from pbl_pipeline.synthetic import NO_NOISE, plain_walk
from pbl_pipeline.video import Camera, probe, read_frames, scaled_matrix
from research.walker.observe import observe
from tests.videos import write_video
from tests.walking_fit import LEVEL_CAMERA_QUAT_WXYZ, walking_fit

CAMERA = Camera(np.array([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]]), np.zeros(5), "test")
LENS = Camera(
    np.array([[900.0, 0, 611], [0, 910, 342], [0, 0, 1]]), np.array([-0.21, 0.09, 0.003, -0.002, 0.01]), "test"
)


def test_level_camera_looks_along_world_x() -> None:
    r = rotation_matrix(LEVEL_CAMERA_QUAT_WXYZ)
    # Columns are camera right, down, forward in the world.
    np.testing.assert_allclose(r.T, [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-12)


def test_quaternion_turns_about_its_axis() -> None:
    half = np.radians(30) / 2
    r = rotation_matrix(np.array([2 * np.cos(half), 0, 0, 2 * np.sin(half)]))  # any length
    np.testing.assert_allclose(r @ [1, 0, 0], [np.cos(2 * half), np.sin(2 * half), 0], atol=1e-12)


def test_projection_agrees_with_opencv() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([-1.5, -0.9, 3], [1.5, 0.9, 6], (50, 3))
    wanted, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), LENS.matrix, LENS.distortion)
    np.testing.assert_allclose(to_pixels(points, LENS), np.asarray(wanted)[:, 0], atol=1e-9)


def test_points_that_no_lens_shows_are_nan() -> None:
    points = np.array([[0, 0, 1.0], [0, 0, NEAR_M / 2], [0.1, 0, -3.0], [0, 0, 0], [np.nan, 0, 1]])
    assert np.isfinite(to_pixels(points, CAMERA)).all(axis=1).tolist() == [True, False, False, False, False]
    # r (1 - 0.2 r^2) turns back at r = sqrt(1 / 0.6) = 1.29; what lies further out would be folded into the picture.
    barrel = dataclasses.replace(CAMERA, distortion=np.array([-0.2, 0, 0, 0, 0]))
    off_axis = np.array([[1.28, 0, 1.0], [1.30, 0, 1.0]])
    assert np.isfinite(to_pixels(off_axis, barrel)).all(axis=1).tolist() == [True, False]


def test_camera_of_a_resized_picture_hits_the_same_place() -> None:
    points = np.array([[0.3, -0.2, 2.0], [-0.5, 0.1, 3.0]])
    full = to_pixels(points, LENS)
    half = to_pixels(points, dataclasses.replace(LENS, matrix=scaled_matrix(LENS.matrix, (0.5, 0.25))))
    np.testing.assert_allclose(half, (full + 0.5) * [0.5, 0.25] - 0.5)


@pytest.mark.parametrize(
    ("name", "side"), [("femur_r", "right"), ("toes_l", "left"), ("torso", "middle"), ("palm_l_2", "left")]
)
def test_side_from_name(name: str, side: str) -> None:
    assert side_of(name) == side


def _image() -> np.ndarray:
    return np.full((360, 640, 3), 255, np.uint8)


def _draw(names: tuple[str, ...], start: list, end: list, radius: float = 0.05, opacity: float = 1.0) -> np.ndarray:
    image = _image()
    n = len(names)
    # Written in the camera's frame, handed over in the world's.
    a, b = (np.asarray(p, float).reshape(n, 3) @ rotation_matrix(LEVEL_CAMERA_QUAT_WXYZ).T for p in (start, end))
    draw_body(image, names, a, b, np.full(n, radius), LEVEL_CAMERA_QUAT_WXYZ, np.zeros(3), CAMERA, opacity)
    return image


def _hue(pixel: np.ndarray) -> str:
    b, _, r = (int(v) for v in pixel)
    return "right" if b > r + 40 else "left" if r > b + 40 else "other"


def test_capsule_colours_the_pixels_it_projects_to() -> None:
    # From (0.4, -0.2, 4) to (0.4, 0.2, 4): pixels (370, 155) to (370, 205), radius 500 * 0.05 / 4 = 6.25 px.
    image = _draw(("tibia_r",), [[0.4, -0.2, 4]], [[0.4, 0.2, 4]])
    drawn = (image != 255).any(axis=2)
    rows, columns = np.flatnonzero(drawn.any(axis=1)), np.flatnonzero(drawn.any(axis=0))
    # The outline lies around the shape, two pixels wide and smoothed.
    assert rows[[0, -1]].mean() == pytest.approx(180, abs=0.6)
    assert columns[[0, -1]].mean() == pytest.approx(370, abs=0.6)
    assert np.ptp(rows) / 2 == pytest.approx(25 + 6.25 + 1.5, abs=1.5)
    assert np.ptp(columns) / 2 == pytest.approx(6.25 + 1.5, abs=1.5)
    assert _hue(image[180, 370]) == "right"
    assert _hue(_draw(("tibia_l",), [[0.4, -0.2, 4]], [[0.4, 0.2, 4]])[180, 370]) == "left"


def test_the_near_limb_covers_the_far_one_in_any_order() -> None:
    near, far = [[0, -0.2, 3]], [[0, -0.2, 5]]
    near_end, far_end = [[0, 0.2, 3]], [[0, 0.2, 5]]
    for names, start, end in (
        (("tibia_l", "tibia_r"), near + far, near_end + far_end),
        (("tibia_r", "tibia_l"), far + near, far_end + near_end),
    ):
        assert _hue(_draw(names, start, end)[180, 320]) == "left"


def test_the_person_stays_visible_through_the_body() -> None:
    opaque = _draw(("tibia_r",), [[0, -0.2, 3]], [[0, 0.2, 3]])[180, 320].astype(float)
    mixed = _draw(("tibia_r",), [[0, -0.2, 3]], [[0, 0.2, 3]], opacity=0.5)[180, 320].astype(float)
    np.testing.assert_allclose(mixed, 0.5 * opaque + 0.5 * 255, atol=1.5)


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ([0, -0.2, -3], [0, 0.2, -3]),  # behind
        ([0, 0, 0.05], [0, 0, 0.02]),  # nearer than what is drawn
        ([np.nan, 0, 3], [0, 0, 3]),
        ([50, 0, 3], [50, 1, 3]),  # beside the picture
    ],
)
def test_what_the_camera_does_not_see_is_not_drawn(start: list[float], end: list[float]) -> None:
    np.testing.assert_array_equal(_draw(("tibia_r",), [start], [end]), _image())


def test_a_limb_that_reaches_behind_the_camera_is_cut_off_there() -> None:
    outline = capsule_outline(np.array([0.0, 0.3, 2.0]), np.array([0.0, 0.3, -2.0]), 0.01, CAMERA)
    assert outline is not None
    # The cut is at 0.1 m: y = 180 + 500 * 0.3 / 0.1; nothing is mirrored to the top of the picture.
    assert outline[:, 1].max() == pytest.approx(180 + 1500 + 50, abs=1)
    assert outline[:, 1].min() == pytest.approx(180 + 75 - 2.5, abs=1)
    assert np.isfinite(outline).all()


def test_huge_and_close_capsules_do_not_overflow() -> None:
    assert (_draw(("femur_r",), [[0, 0, 0.1001]], [[900, 0, 0.1001]], radius=50.0) != 255).any()


def test_keypoints_are_dots_where_they_were_seen() -> None:
    image = np.zeros((100, 200, 3), np.uint8)
    draw_keypoints(image, np.array([[50.0, 40], [150, 60], [np.nan, 3], [10, 10]]), np.array([0.9, 0.2, 0.9, 0.0]))
    assert image[40, 50].sum() > 300  # filled
    assert image[60, 150].sum() < 100  # hollow
    assert image[55:66, 145:156].sum() > 0
    assert image[:20, :20].sum() == 0


def _event(time_s: float, side: str, event: str) -> GaitEvent:
    return GaitEvent(time_s, side, event, 1.0)


def test_stance_is_claimed_only_between_a_foot_down_and_the_next_foot_up() -> None:
    events = [
        _event(0.2, "right", "foot_up"),
        _event(0.6, "right", "foot_down"),
        _event(1.2, "right", "foot_up"),
        _event(1.6, "right", "foot_down"),
        _event(2.6, "right", "foot_down"),
        _event(3.0, "right", "foot_up"),
        _event(3.4, "right", "foot_down"),
        _event(0.1, "left", "foot_down"),
    ]
    assert stance_spans(events[::-1], "right") == [(0.6, 1.2), (2.6, 3.0)]
    assert stance_spans(events, "left") == []


# --- the video -------------------------------------------------------------------------------------------------

N = 24


@pytest.fixture(scope="module")
def walk():
    return walking_fit(n_frames=N, seen=(4, 20), start_m=(4.0, -0.5, -0.1))


@pytest.fixture(scope="module")
def clip(walk, tmp_path_factory) -> tuple[Path, np.ndarray]:
    """A grey video of 640 x 360 whose frames come at uneven times."""
    steps = np.where(np.arange(N) % 5 == 0, 0.05, 1 / 30)
    time = np.concatenate([[0.0], np.cumsum(steps)[:-1]])
    frames = (np.full((360, 640, 3), 200, np.uint8) for _ in range(N))
    return write_video(tmp_path_factory.mktemp("clip") / "clip.mp4", frames, time), time


def test_overlay_keeps_every_frame_and_its_time(walk, clip, tmp_path: Path) -> None:
    path, time = clip
    events = [_event(0.2, "left", "foot_down"), _event(0.5, "left", "foot_up")]
    out = render_overlay(path, walk, tmp_path / "new" / "overlay.mp4", events=events)
    before, after = probe(path), probe(out)
    assert after.n_frames == N
    np.testing.assert_allclose(after.time_s, before.time_s, atol=1e-5)
    np.testing.assert_allclose(after.time_s, time, atol=1e-4)
    assert after.variable_frame_rate
    assert (after.codec, after.pixel_format) == ("h264", "yuv420p")
    assert after.width_px % 2 == after.height_px % 2 == 0
    assert after.duration_s == pytest.approx(time[-1] + np.median(np.diff(time)), abs=0.02)
    assert [p.name for p in out.parent.iterdir()] == ["overlay.mp4"]


@pytest.fixture(scope="module")
def overlay(walk, clip, tmp_path_factory) -> Path:
    return render_overlay(clip[0], walk, tmp_path_factory.mktemp("overlay") / "o.mp4")


def test_overlay_plays_in_browsers(overlay) -> None:
    data = overlay.read_bytes()
    assert data.find(b"moov") < data.find(b"mdat")  # the index stands at the front
    with av.open(str(overlay)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.profile in ("High", "Main")
        assert stream.codec_context.colorspace == stream.codec_context.color_primaries == 1  # tagged BT.709


def test_the_body_is_drawn_where_the_fit_is_known_and_nowhere_else(overlay) -> None:
    for frame in read_frames(overlay):
        picture = frame.image[:360].astype(int)
        coloured = (np.ptp(picture, axis=2) > 60).sum()
        if 4 <= frame.index < 20:
            assert coloured > 500, frame.index
        else:
            assert coloured == 0, frame.index
            assert picture.mean() == pytest.approx(200, abs=8)  # two conversions to 4:2:0 and back


def test_the_strip_shows_time_and_both_knees(overlay) -> None:
    frames = list(read_frames(overlay))
    first, last = frames[0].image[360:].astype(int), frames[-1].image[360:].astype(int)
    assert first.mean() > 200  # a white strip
    assert np.abs(first - last).max() > 80  # the cursor moved
    assert (first[..., 0] > first[..., 2] + 60).any()  # right: blue
    assert (first[..., 2] > first[..., 0] + 60).any()  # left: vermilion


def test_large_video_is_scaled_down(walk, clip, tmp_path: Path) -> None:
    info = probe(render_overlay(clip[0], walk, tmp_path / "o.mp4", max_side_px=321))
    assert info.width_px == 320
    assert info.n_frames == N


def test_body_lies_on_its_projection(walk, clip) -> None:
    """The pelvis of frame 10 is drawn at the pixel that its position in the fit projects to."""
    (image,) = overlay_frames(clip[0], walk, [10])
    column = {n: i for i, n in enumerate(walk.joint_names)}
    q = walk.qpos[10]
    pelvis = np.array([q[column["pelvis_tx"]], -q[column["pelvis_tz"]], 0.975 + q[column["pelvis_ty"]]])
    x, y = to_pixels(to_camera(pelvis, LEVEL_CAMERA_QUAT_WXYZ, np.zeros(3)), walk.camera)
    changed = np.abs(image.astype(int) - 200).max(axis=2) > 20
    assert changed[round(y), round(x)]
    rows, columns = np.nonzero(changed)
    assert abs(columns.mean() - x) < 25
    # 1.75 m or so of a person at 4 m, in a picture of 600 px focal length
    assert 225 < np.ptp(rows) < 300


def test_a_camera_that_stands_elsewhere_sees_the_same_body(walk, clip) -> None:
    """Camera and body moved together by 2 m along world x and 1 m up: the same picture."""
    column = {n: i for i, n in enumerate(walk.joint_names)}
    qpos = walk.qpos.copy()
    qpos[:, column["pelvis_tx"]] += 2
    qpos[:, column["pelvis_ty"]] += 1
    moved = dataclasses.replace(walk, qpos=qpos, camera_position_m=np.array([2.0, 0, 1]))
    (here,), (there,) = (overlay_frames(clip[0], fit, [10], crop_to_body=True) for fit in (walk, moved))
    assert here.shape == there.shape
    assert np.mean(np.abs(here.astype(int) - there) > 8) < 0.002  # single precision of the poses
    (left,) = overlay_frames(clip[0], dataclasses.replace(moved, camera_position_m=np.zeros(3)), [10])
    assert np.mean(left != overlay_frames(clip[0], walk, [10])[0]) > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("tilt_deg", [(12.0, 5.0), (-8.0, -4.0)])
def test_the_fit_of_a_tilted_camera_lies_on_the_person(tilt_deg: tuple[float, float]) -> None:
    """The vertical is estimated from the walk, and the body stays where it is seen, upright in the world."""
    time_s = np.arange(120) / 30
    # A camera 1.2 m above the ground sees her walk from right to left.
    qpos = plain_walk(time_s, start_m=(5.0, -2.4))
    seen = observe(qpos, time_s, noise=NO_NOISE, tilt_deg=tilt_deg)
    fit = fit_session([seen.keypoints], ["walk"]).trials[0]
    assert fit.orientation_source == "estimated: gait"
    np.testing.assert_allclose(
        rotation_matrix(fit.phone_quat_wxyz[0])[2], seen.R_nc[0][2], atol=np.radians(2)
    )  # third row: the world's vertical as the camera sees it
    middle = 60
    points = to_camera(fit.markers_world_m[middle], fit.phone_quat_wxyz[middle], fit.camera_position_m)
    away = np.linalg.norm(to_pixels(points, fit.camera) - seen.keypoints.xy_px[middle], axis=-1)
    assert np.median(away) < 5
    # The pelvis' tilt against the walking direction is that of the walker, whatever the camera's tilt.
    level = dataclasses.replace(fit, qpos=qpos, phone_quat_wxyz=np.tile(LEVEL_CAMERA_QUAT_WXYZ, (120, 1)))
    got, wanted = (angle_series(f).left["pelvis_tilt"] for f in (fit, level))
    assert abs(np.nanmean(got - wanted)) < 4


def test_frames_come_in_the_order_asked_for(walk, clip) -> None:
    images = overlay_frames(clip[0], walk, [12, 2, 12])
    np.testing.assert_array_equal(images[0], images[2])
    assert np.ptp(images[1].astype(int), axis=2).max() < 10  # frame 2 has no fit
    assert images[0].shape == (360, 640, 3)
    assert overlay_frames(clip[0], walk, []) == []


def test_crop_holds_the_body(walk, clip) -> None:
    (whole,) = overlay_frames(clip[0], walk, [10])
    (part,) = overlay_frames(clip[0], walk, [10], crop_to_body=True)
    assert part.shape[1] / part.shape[0] == pytest.approx(4 / 3, abs=0.02)
    count = [(np.ptp(i.astype(int), axis=2) > 60).sum() for i in (whole, part)]
    assert count[0] == count[1]
    (empty,) = overlay_frames(clip[0], walk, [0], crop_to_body=True)
    assert empty.shape == whole.shape


def test_report_indices_are_known_frames(walk) -> None:
    assert report_indices(walk) == [6, 12, 16]
    nothing = dataclasses.replace(walk, qpos=np.full_like(walk.qpos, np.nan))
    assert report_indices(nothing) == []
    one = np.full_like(walk.qpos, np.nan)
    one[7] = walk.qpos[7]
    assert report_indices(dataclasses.replace(walk, qpos=one)) == [7]


def test_fit_without_one_frame_gives_the_bare_video(walk, clip, tmp_path: Path) -> None:
    nothing = dataclasses.replace(walk, qpos=np.full_like(walk.qpos, np.nan))
    # Not by `probe`: without a body nothing but drawn, exactly straight lines is left, as on a screen.
    assert len(list(read_frames(render_overlay(clip[0], nothing, tmp_path / "o.mp4")))) == N


def test_keypoints_are_drawn_at_their_pixels(walk, clip) -> None:
    keypoints = _keypoints(N)
    (image,) = overlay_frames(clip[0], walk, [0], keypoints)
    assert image[100, 300, 0] < 120 < image[100, 300, 2]  # a yellow dot
    assert image[200, 500].tolist() == pytest.approx([200] * 3, abs=6)


def _keypoints(n: int) -> Keypoints:
    return Keypoints(
        time_s=np.arange(n) / 30,
        names=("nose",),
        marker_set="blazepose_33",
        xy_px=np.tile([[[300.0, 100.0]]], (n, 1, 1)),
        xyz_cam_m=np.full((n, 1, 3), np.nan),
        root_relative=True,
        confidence=np.full((n, 1), 0.9),
        image_size_px=(640, 360),
        camera=CAMERA,
        box_px=np.full((n, 4), np.nan),
    )


def test_files_of_another_video_are_refused(walk, clip, tmp_path: Path) -> None:
    out = tmp_path / "o.mp4"
    cases = {
        "VIDEO_CHANGED": dataclasses.replace(walk, image_size_px=(360, 640)),
        "FILE_FORMAT": dataclasses.replace(walk, body_sha256="0" * 64),
    }
    for code, fit in cases.items():
        with pytest.raises(PblError, match=rf"^{code}: "):
            render_overlay(clip[0], fit, out)
    for n in (N - 1, N + 1):
        with pytest.raises(PblError, match=r"^VIDEO_CHANGED: "):
            render_overlay(clip[0], walking_fit(n_frames=n), out)
    with pytest.raises(PblError, match=r"^FILE_FORMAT: "):
        render_overlay(clip[0], walk, out, _keypoints(N - 2))
    with pytest.raises(PblError, match=r"^USAGE: "):
        overlay_frames(clip[0], walk, [N])
    with pytest.raises(PblError, match=r"^VIDEO_MISSING: "):
        render_overlay(tmp_path / "absent.mp4", walk, out)
    assert list(tmp_path.iterdir()) == []  # no half file is left


def test_an_overlay_has_the_frames_that_the_fit_has(walk, clip, tmp_path: Path) -> None:
    """A keypoint method may leave frames out: each pose is drawn into its own frame, the others are not shown."""
    path, time = clip
    number = np.array([*range(0, N, 2), N - 1])

    def of(number: np.ndarray, shown: np.ndarray) -> TrialFit:
        names = ("qpos", "qpos_sd", "markers_world_m", "phone_quat_wxyz", "residual_2d_px", "residual_3d_m")
        rows = {n: getattr(walk, n)[number[: len(shown)]] for n in names}
        return dataclasses.replace(walk, **rows, time_s=time[number[: len(shown)]], frame=shown)

    fit = of(number, number)
    shown = read_frames(render_overlay(path, fit, tmp_path / "o.mp4"))
    np.testing.assert_allclose([f.time_s for f in shown], time[number], atol=1e-4)
    (here,), (there,) = overlay_frames(path, fit, [5]), overlay_frames(path, walk, [10])
    np.testing.assert_array_equal(here, there)
    for other in (number[:-1], np.append(number[:-1], N)):
        with pytest.raises(PblError, match=r"^VIDEO_CHANGED: "):
            render_overlay(path, of(number, other), tmp_path / "p.mp4")
    fit.save(tmp_path / "walk.fit.npz")
    again = TrialFit.load(tmp_path / "walk.fit.npz").frame
    assert again is not None
    assert again.tolist() == number.tolist()
    walk.save(tmp_path / "all.fit.npz")
    assert TrialFit.load(tmp_path / "all.fit.npz").frame is None


def test_sides_differ_for_every_colour_vision() -> None:
    """Blue and vermilion: the blue channel alone tells them apart, which no common colour blindness loses."""
    right, left = SIDE_COLOUR["right"], SIDE_COLOUR["left"]
    assert abs(int(right[5:], 16) - int(left[5:], 16)) > 120


def test_a_side_is_uncertain_behind_the_other_when_badly_seen_or_of_a_wide_interval() -> None:
    time = np.arange(6.0)
    sd = np.array([5.0, 5, 20, 25, np.nan, 5])
    flat = np.full(6, 3.0)
    found = uncertain_sides(
        time, [("left", 0.5, 1.5)], None, {"left": {"knee": flat}, "right": {"hip": flat, "knee": sd}}
    )
    assert found["left"].tolist() == [False, True, False, False, False, False]
    assert found["right"].tolist() == [False, False, True, True, False, False]


def test_the_track_of_the_body_puts_its_capsules_where_they_are_drawn() -> None:
    body = load_body()
    fit = dataclasses.replace(walking_fit(n_frames=30, seen=(3, 28)), scale=np.linspace(0.9, 1.1, 8))
    track, drawn = body_track(fit), capsules(body, fit.qpos, fit.scale)
    assert np.isnan(track.root_m[[0, 2, 28]]).all()
    turned = rotation_matrix(track.quat_wxyz[3:28])
    at = np.zeros((25, len(body.body_names), 3))
    for b, parent in enumerate(track.parent):
        carried = np.einsum("tij,j->ti", turned[:, parent], track.offset_m[b])
        at[:, b] = track.root_m[3:28] if parent < 0 else at[:, parent] + carried
    own = track.shapes.body
    start = at[:, own] + np.einsum("tgij,gj->tgi", turned[:, own], track.shapes.start)
    np.testing.assert_allclose(start, drawn.start[3:28], atol=1e-9)
    assert {n for n, leg in zip(body.body_names, track.leg, strict=True) if leg} == {
        f"{part}_{side}" for part in ("femur", "tibia", "talus", "calcn", "toes") for side in "lr"
    }
    assert (np.sum(track.quat_wxyz[4:28] * track.quat_wxyz[3:27], axis=2) > 0).all()

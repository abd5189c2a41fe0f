"""One scene inside Blender: it opens assets, answers rays, and renders frames with their depth.

A process of its own imports it (`process.py`), because Blender is a global of its process.

Axes here are Blender's: right-handed, x and y level, z up, in units of the map's file. Map
axes are the same but for the sign of y. Depth is Cycles' own, of a render of one ray through the
centre of each pixel. Blender evaluates a scene anew for each render, and otherwise than for its
windows. So the triangles that filters ask are taken from the evaluation that Cycles renders.
"""

import math
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import bpy
import numpy as np
from mathutils import Matrix
from mathutils.bvhtree import BVHTree

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.synthesis.blender.assets import (
    AnimationAsset,
    Asked,
    CharacterAsset,
    MapAsset,
    RenderSettings,
    Shot,
)

Array = Any

_FLIP: Final = np.array([1.0, -1.0, 1.0])
"""Turns map axes into Blender's, and back."""
_RATE_HZ: Final = 15.0
_MESHES: Final = frozenset({"MESH", "CURVE", "SURFACE", "FONT", "META"})
_WITHOUT_DEPTH: Final = frozenset({"VOLUME", "GREASEPENCIL"})
_OPEN_SKY_M: Final = 20.0
"""How far above its highest point cameras may be in a map without a ceiling."""
_OPEN_SHARE: Final = 0.3
_GRID: Final = 12
_SIZES_M: Final = {
    "width": (2.0, 500.0, 4.0, 200.0),
    "height inside": (1.8, 40.0, 2.0, 12.0),
    "height": (0.5, 3.0, 0.5, 3.0),
}
"""From where to where sizes of maps, rooms and subjects are taken for right, and are usual."""
_UNITS_M: Final = (0.01, 100.0, 0.001, 1000.0, 0.0254, 39.37, 0.3048, 3.281, 0.1, 10.0)
_POINTS: Final = 24
_MOST_STEPS: Final = 300
_STRIP_FRAMES: Final = 1e6
_CYCLE_M: Final = 0.05
_STILL_M: Final = 0.02
_BONE_PATH: Final = re.compile(r'pose\.bones\["((?:[^"\\]|\\.)*)"\]\.(\w+)')
_NOTHING: Final = 1e9
"""Depth of Cycles' pass from which on nothing is seen."""
_NARROWEST_PX: Final = 0.01
"""Cycles' narrowest filter: rays pass within half of it of the centre of their pixel."""
_MOST_LAYERS: Final = 64
_GPU_KINDS: Final = ("OPTIX", "CUDA", "HIP", "ONEAPI", "METAL")


# What rays of the filters meet: triangles of the evaluated map.


class Triangles:
    """What cameras see of an evaluated scene, with a tree that finds the first that a ray meets.

    Attributes:
        vertices: (n, 3) in Blender's world axes, with modifiers applied.
    """

    def __init__(self, depsgraph: Any) -> None:
        vertices, corners, count = [np.empty((0, 3))], [np.empty((0, 3), int)], 0
        for instance in depsgraph.object_instances:
            shown = instance.object
            if shown.type in _MESHES and instance.show_self and shown.visible_camera:
                points, triangles = _mesh_of(shown)
                matrix = np.array(instance.matrix_world)
                vertices.append(points @ matrix[:3, :3].T + matrix[:3, 3])
                corners.append(triangles + count)
                count += len(points)
        self.vertices = np.concatenate(vertices)
        self._tree = BVHTree.FromPolygons(
            self.vertices.tolist(), np.concatenate(corners).tolist(), all_triangles=True
        )

    def first_hits(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Return how far rays (n, 3) of unit direction go, and how much upwards the faces look.

        Both are (n,): infinity and nan where a ray meets nothing.
        """
        found = []
        for origin, direction in zip(origins.tolist(), directions.tolist(), strict=True):
            _, normal, _, distance = self._tree.ray_cast(origin, direction)
            found.append((np.inf, np.nan) if normal is None else (distance, normal.z))
        distances, upwards = np.array(found).reshape(-1, 2).T
        return distances, upwards


def _mesh_of(shown: Any) -> tuple[Array, Array]:
    """Return vertices (n, 3) and triangles (m, 3) of an evaluated object, in its own axes."""
    mesh = shown.to_mesh()
    if mesh is None:
        return np.empty((0, 3)), np.empty((0, 3), int)
    mesh.calc_loop_triangles()
    vertices = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", vertices)
    corners = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("vertices", corners)
    shown.to_mesh_clear()
    return vertices.reshape(-1, 3).astype(np.float64), corners.reshape(-1, 3).astype(int)


def _render(before: Callable[[Any], object] = id, after: Callable[[Any], object] = id) -> None:
    """Let Cycles render; hand over the scene as evaluated for it before, and its engine after."""
    from cycles import CyclesRender, engine

    def render(self: Any, depsgraph: Any) -> None:
        before(depsgraph)
        engine.render(self, depsgraph)
        after(self)

    own = CyclesRender.render
    CyclesRender.render = render
    try:
        bpy.ops.render.render()
    finally:
        CyclesRender.render = own


# Files.


def _inside(path: str, root: str) -> bool:
    real, root = os.path.realpath(path), os.path.realpath(root)
    return os.path.commonpath([real, root]) == root


def check_files(where: str, *, root: str) -> None:
    """Refuse what was opened if it needs files outside the asset folder, or missing ones."""
    own = bpy.utils.resource_path("LOCAL")
    for path in bpy.utils.blend_paths(absolute=True, packed=False, local=False):
        if Path(path).exists() and not _inside(path, root) and not _inside(path, own):
            raise SynthesisError(
                f"{where}: it refers to {path}, which is outside the asset folder {root}. Copy "
                f"that file into the folder and point to it there, or pack it into the .blend file."
            )
    missing = {library.filepath for library in bpy.data.libraries if library.is_missing}
    for image in bpy.data.images:
        is_needed = image.source in ("FILE", "SEQUENCE", "MOVIE") and (
            image.users > image.use_fake_user and not image.packed_files
        )
        path = bpy.path.abspath(image.filepath, library=image.library)
        if is_needed and not Path(path).exists():
            missing.add(image.filepath or image.name)
    if missing:
        raise SynthesisError(
            f"{where}: {len(missing)} of its files are missing: {_few(missing)}. Copy them beside "
            f"it and repair the paths (Blender: File, External Data, Find Missing Files), or pack "
            f"them."
        )


def _rate_hz(scene: Any) -> float:
    return float(scene.render.fps / scene.render.fps_base)


@contextmanager
def _opening(where: str) -> Iterator[None]:
    """Say which file Blender cannot open."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        why = str(error).strip().rpartition("\n")[2] or "no reason given"
        raise SynthesisError(
            f"{where}: Blender cannot open it ({why}). Repair it, and save it by Blender 5.2 as a "
            f".blend file."
        ) from error


def _import(path: str) -> None:
    """Add the content of a glTF or FBX file to the scene."""
    if Path(path).suffix.lower() in (".glb", ".gltf"):
        bpy.ops.import_scene.gltf(filepath=path, import_scene_as_collection=False)
    else:
        bpy.ops.wm.fbx_import(filepath=path)


def _add(path: str, where: str) -> tuple[list[Any], list[Any], float]:
    """Add a file to the scene; return its new objects, its actions and their frames a second."""
    before, actions = set(bpy.data.objects), set(bpy.data.actions)
    for number, action in enumerate(actions):
        if action.library is None:
            action.name = f"stereogenbench {number}"  # So that takes keep the names in their file.
    if Path(path).suffix.lower() == ".blend":
        with _opening(where), bpy.data.libraries.load(path, link=False) as (there, wanted):
            wanted.scenes = there.scenes[:1]
            wanted.actions = there.actions
        rate_hz = 24.0
        here = bpy.context.scene.collection
        for scene in wanted.scenes:
            rate_hz = _rate_hz(scene)
            shown = set(_rendered(scene.view_layers[0].layer_collection))
            for item in set(scene.objects) - before:
                item.hide_render |= item not in shown
                here.objects.link(item)
            bpy.data.scenes.remove(scene)
    else:
        rate_hz = _rate_hz(bpy.context.scene)
        with _opening(where):
            _import(path)
    objects = [item for item in bpy.data.objects if item not in before]
    return objects, [item for item in bpy.data.actions if item not in actions], rate_hz


def _rendered(layer: Any) -> Iterator[Any]:
    """Yield the objects of a layer and those below it, without what is not rendered."""
    if layer.exclude or layer.collection.hide_render:
        return
    yield from layer.collection.objects
    for child in layer.children:
        yield from _rendered(child)


# Light.


def _add_sky(scene: Any) -> None:
    """Light a map that has no light of its own: a sun, and a bluish sky."""
    sun = bpy.data.lights.new("StereoGenBench sun", "SUN")
    sun.energy, sun.angle = 3.0, math.radians(2)
    item = bpy.data.objects.new(sun.name, sun)
    item.rotation_euler = (math.radians(38), math.radians(12), math.radians(25))
    scene.collection.objects.link(item)
    world = bpy.data.worlds.new("StereoGenBench sky")
    world.use_nodes = True
    background = next(
        node for node in world.node_tree.nodes if node.bl_idname == "ShaderNodeBackground"
    )
    background.inputs["Color"].default_value = (0.65, 0.78, 1.0, 1.0)
    background.inputs["Strength"].default_value = 0.9
    scene.world = world


# The subject.


class Subject:
    """A character with one take of an animation, below an empty object that places it."""

    def __init__(
        self, character: CharacterAsset, animation: AnimationAsset, *, root: str, unit_m: float
    ) -> None:
        objects, actions, rate_hz = _add(character.file, character.where)
        check_files(character.where, root=root)
        self.objects = [item for item in objects if item.type not in ("LIGHT", "CAMERA", "SPEAKER")]
        for item in objects:
            if item not in self.objects:
                bpy.data.objects.remove(item)
        self.armature = _armature_of(self.objects, where=character.where)
        if animation.file != character.file:
            others, actions, rate_hz = _add(animation.file, animation.where)
            check_files(animation.where, root=root)
            for item in others:
                bpy.data.objects.remove(item)
        action = _take(actions, name=animation.take, where=animation.where)
        self.rate_hz = animation.rate_hz or rate_hz
        self.start, end = map(float, action.frame_range)
        self.frames = max(end - self.start, 1e-6)
        self.strip = self._animate(action, where=animation.where)
        self.unit_m = unit_m
        self.empty = bpy.data.objects.new("StereoGenBench subject", None)
        bpy.context.scene.collection.objects.link(self.empty)
        for item in self.objects:
            if item.parent is None:
                item.parent = self.empty
        self.scale = character.scale / unit_m
        self.facing = {"-y": 0.0, "+x": -90.0, "+y": 180.0, "-x": 90.0}[character.forward]
        self._measure(character, repeat=animation.repeat)

    def _animate(self, action: Any, *, where: str) -> Any:
        """Bind the take to the armature, in place of all that moved its objects.

        Its time is then that of the strip, which is set by hand.
        """
        bones = self.armature.data.bones
        own_slot = max(
            action.slots, key=lambda slot: len(_bones_of(action, slot).keys() & bones.keys())
        )
        moved = _bones_of(action, own_slot)
        if not moved.keys() & bones.keys():
            raise SynthesisError(
                f"{where}: the take {action.name!r} moves no bone of the armature "
                f"{self.armature.name!r}: it has {_few(moved)}, the armature has "
                f"{_few(bones.keys())}. Name an animation of the same skeleton, or retarget it."
            )
        for bone in moved.keys() & bones.keys():
            pose, names = self.armature.pose.bones[bone], moved[bone]
            if "rotation_quaternion" in names:
                pose.rotation_mode = "QUATERNION"
            elif "rotation_euler" in names and pose.rotation_mode in ("QUATERNION", "AXIS_ANGLE"):
                pose.rotation_mode = "XYZ"
        for item in self.objects:
            for owner in (item, getattr(item.data, "shape_keys", None)):
                if owner is not None and owner.animation_data is not None:
                    owner.animation_data.action = None
                    for track in list(owner.animation_data.nla_tracks):
                        owner.animation_data.nla_tracks.remove(track)
        tracks = self.armature.animation_data_create().nla_tracks
        strip = tracks.new().strips.new("take", 1, action)
        strip.action_slot = own_slot
        strip.frame_end = strip.frame_start + _STRIP_FRAMES
        strip.frame_start = -_STRIP_FRAMES
        strip.use_animated_time = True
        return strip

    def _measure(self, character: CharacterAsset, *, repeat: str) -> None:
        """Find the soles, the height, and how the take repeats."""
        scale = character.scale
        self.place(None, time_frames=self.start)
        points = self._vertices()
        if not len(points):
            raise SynthesisError(
                f"{character.where}: it has no mesh that is rendered. Export the mesh with "
                f"the armature, or show it in renders."
            )
        low, high = points.min(axis=0), points.max(axis=0)
        _require_size("height", float(high[2] - low[2]) * scale, character)
        self.chosen = _spread(points)
        first = self._bones()
        # No frame puts a sole below the floor on which the subject stands.
        steps = min(_MOST_STEPS, math.ceil(self.frames / self.rate_hz * _RATE_HZ))
        lowest = low[2]
        for step in range(1, steps + 1):
            self.place(None, time_frames=self.start + self.frames * step / steps)
            lowest = min(lowest, self._vertices()[:, 2].min())
        self.soles = np.array([*(low + high)[:2] / 2, lowest])
        self.place(None, time_frames=self.start + self.frames)
        moved = (self._bones() - first) * scale
        whole = moved.mean(axis=0)
        self.travel = np.zeros(3)
        self.is_cyclic = repeat == "onward" and bool(
            np.linalg.norm(moved - whole, axis=1).max() < _CYCLE_M
        )
        if self.is_cyclic and np.linalg.norm(whole[:2]) > _STILL_M:
            self.travel = np.array([*whole[:2], 0.0]) / scale

    def time_of(self, frame: int) -> tuple[float, int]:
        """Return the frame of the take at a frame of the clip, and how often it was played before.

        A take that ends as it begins is repeated, and one that also moves on goes on from there;
        any other is played to its end and back.
        """
        played = frame / _RATE_HZ * self.rate_hz
        times, rest = divmod(played, self.frames)
        if self.is_cyclic:
            return self.start + rest, int(times)
        return self.start + (self.frames - rest if int(times) % 2 else rest), 0

    def place(
        self, spawn: tuple[Array, float] | None, *, time_frames: float, times: int = 0
    ) -> None:
        """Put the subject at a place and a heading, in its file's own axes for None."""
        self.strip.strip_time = time_frames
        if spawn is None:
            self.empty.matrix_world = Matrix.Identity(4)
        else:
            place, heading_deg = spawn
            turn = Matrix.Rotation(math.radians(heading_deg + self.facing), 4, "Z")
            shift = np.asarray(self.soles if not times else self.soles - times * self.travel)
            self.empty.matrix_world = (
                Matrix.Translation(place.tolist())
                @ turn
                @ Matrix.Scale(self.scale, 4)
                @ Matrix.Translation((-shift).tolist())
            )
        bpy.context.scene.frame_set(bpy.context.scene.frame_current)

    def points_m(self, frame: int) -> Array:
        """Return points of the body in map axes, for a subject that starts at 0 with a yaw of 0."""
        time_frames, times = self.time_of(frame)
        self.place(None, time_frames=time_frames)
        points = self._vertices()[self.chosen] + times * self.travel - self.soles
        turn = np.array(Matrix.Rotation(math.radians(90.0 + self.facing), 3, "Z"))
        return points @ turn.T * (self.scale * self.unit_m) * _FLIP

    def _vertices(self) -> Array:
        """Return all vertices of the posed meshes, in file units."""
        depsgraph = bpy.context.evaluated_depsgraph_get()
        found = [np.empty((0, 3))]
        for item in self.objects:
            if item.type not in _MESHES or item.hide_render or not item.visible_camera:
                continue
            shown = item.evaluated_get(depsgraph)
            matrix = np.array(shown.matrix_world)
            found.append(_mesh_of(shown)[0] @ matrix[:3, :3].T + matrix[:3, 3])
        return np.concatenate(found)

    def _bones(self) -> Array:
        """Return the heads and tails of all bones, in file units."""
        shown = self.armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
        matrix = np.array(shown.matrix_world)
        ends = np.array([end for bone in shown.pose.bones for end in (bone.head, bone.tail)])
        return ends @ matrix[:3, :3].T + matrix[:3, 3]


def _armature_of(objects: list[Any], *, where: str) -> Any:
    """Return the armature with the most bones.

    Meshes that hang on no armature are hidden: they are no part of the subject, such as a floor
    that it stands on.
    """
    armatures = [item for item in objects if item.type == "ARMATURE"]
    if not armatures:
        raise SynthesisError(
            f"{where}: it has no armature, so it cannot be animated; it has "
            f"{_few({item.type.lower() for item in objects})}. Export the skeleton with the mesh, "
            f"or name another file."
        )
    for item in objects:
        item.hide_render |= item.type in _MESHES and not _is_bound(item)
    return max(armatures, key=lambda item: len(item.data.bones))


def _is_bound(item: Any) -> bool:
    """Return whether an armature moves an object or one that it hangs on."""
    while item is not None:
        if item.type == "ARMATURE" or any(each.type == "ARMATURE" for each in item.modifiers):
            return True
        item = item.parent
    return False


def _bones_of(action: Any, slot: Any) -> dict[str, set[str]]:
    """Return the bones that a slot of an action moves, with the properties that it moves."""
    moved: dict[str, set[str]] = {}
    for layer in action.layers:
        for strip in layer.strips:
            bag = strip.channelbag(slot)
            for curve in bag.fcurves if bag is not None else ():
                if path := _BONE_PATH.fullmatch(curve.data_path):
                    bone = bpy.utils.unescape_identifier(path[1])
                    moved.setdefault(bone, set()).add(path[2])
    return moved


def _take(actions: list[Any], *, name: str | None, where: str) -> Any:
    takes = {
        action.name: action
        for action in actions
        if any(_bones_of(action, slot) for slot in action.slots)
    }
    if name is None and len(takes) == 1:
        return next(iter(takes.values()))
    matching = [action for full, action in takes.items() if name in (full, *full.split("|"))]
    if len(matching) != 1:
        asked = "" if name is None else f"; take = {name!r} names {len(matching)} of them"
        raise SynthesisError(
            f"{where}: it has {len(takes)} takes that move bones ({_few(takes, 12)}){asked}. Name "
            f"one of them by `take`, or export the animation with the armature."
        )
    return matching[0]


def _few(names: Any, most: int = 4) -> str:
    shown = sorted(names)
    return (", ".join(map(repr, shown[:most])) or "nothing") + (
        ", ..." if len(shown) > most else ""
    )


def _require_size(noun: str, size_m: float, asset: MapAsset | CharacterAsset) -> None:
    """Refuse a size that tells of a wrong scale, and name the scale that makes it a usual one."""
    least, most, usual_least, usual_most = _SIZES_M[noun]
    if least <= size_m <= most:
        return
    likely = [factor for factor in _UNITS_M if usual_least <= size_m * factor <= usual_most]
    cure = f"Set scale = {asset.scale * likely[0]:g}" if likely else "Set scale to metres in a unit"
    raise SynthesisError(
        f"{asset.where}: its {noun} is {size_m:.3g} m, and should be {least:g} to {most:g} m. "
        f"{cure} there. If a map is right, set bounds_m to the part where cameras may be."
    )


def _spread(points: Array) -> Array:
    """Return the indices of points spread over a body, among them its lowest and its highest."""
    chosen = [int(points[:, 2].argmin()), int(points[:, 2].argmax())]
    far = np.minimum(*(np.linalg.norm(points - points[one], axis=1) for one in chosen))
    while len(chosen) < _POINTS:
        chosen.append(int(far.argmax()))
        far = np.minimum(far, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


# The scene.


class Stage:
    """The one scene of this process: a map, and a subject in it.

    What another process calls (`cast`, `facts`, `render`) is given the assets of a proposal first.
    Every method raises `SynthesisError` if an asset cannot be used.
    """

    def __init__(self, root: str, asset: MapAsset) -> None:
        self.root, self.asset = root, asset
        where = asset.where
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.context.preferences.filepaths.use_scripts_auto_execute = False
        with _opening(where):
            if Path(asset.file).suffix.lower() == ".blend":
                bpy.ops.wm.open_mainfile(filepath=asset.file, load_ui=False, use_scripts=False)
            else:
                _import(asset.file)
        check_files(where, root=self.root)
        self.scene = bpy.context.scene
        units = self.scene.unit_settings
        self.unit_m = asset.scale * (1.0 if units.system == "NONE" else float(units.scale_length))
        self.start = self.scene.frame_start
        self.rate_hz = _rate_hz(self.scene)
        self.notes: list[str] = []
        self._prepare()
        if asset.light == "sky":
            _add_sky(self.scene)
        self.subject: Subject | None = None
        self._own: set[Any] = set()
        self._subject_assets: tuple[CharacterAsset, AnimationAsset] | None = None
        self.triangles = self._gather()
        self.bounds_m, self.spawn_bounds_m = self._bounds()
        self._own = {*bpy.data.objects, *bpy.data.actions}

    def _prepare(self) -> None:
        """Switch off what has no depth, or would differ between picture and depth."""
        scene = self.scene
        render = scene.render
        render.use_compositing = render.use_sequencer = False
        render.use_motion_blur = render.use_border = render.use_stamp = False
        render.use_freestyle = render.film_transparent = False
        render.resolution_percentage = 100
        render.dither_intensity = 0.0
        for item in scene.objects:
            if item.type in _WITHOUT_DEPTH and not item.hide_render:
                item.hide_render = True
                self.notes.append(f"object {item.name!r} ({item.type.lower()}), hidden: no depth")
        for layer in scene.view_layers:
            layer.use = layer == bpy.context.view_layer
        scene.frame_set(self.start)
        if bpy.app.autoexec_fail:
            self.notes.append(bpy.app.autoexec_fail_message)

    def _gather(self) -> Triangles:
        """Return the map's triangles at its first frame, without the subject."""
        found: list[Triangles] = []
        self.scene.render.engine = "CYCLES"
        self.scene.render.use_multiview = False
        self.scene.render.resolution_x = self.scene.render.resolution_y = 1
        self.scene.cycles.samples = 1
        if self.scene.camera is None:
            camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
            self.scene.collection.objects.link(camera)
            self.scene.camera = camera
        _render(before=lambda depsgraph: found.append(Triangles(depsgraph)))
        return found[-1]

    def _bounds(self) -> tuple[Array, Array]:
        """Return two corners of where cameras may be, and of where subjects are spawned."""
        asset = self.asset
        points = self.triangles.vertices
        if not len(points):
            raise SynthesisError(
                f"{asset.where}: the map is empty: no mesh of its scene is rendered. Show its "
                f"collections in renders, or name another file."
            )
        corners = np.stack([points.min(axis=0), points.max(axis=0)]) * _FLIP * self.unit_m
        bounds_m: Array = np.sort(corners, axis=0)
        low, high = bounds_m
        floor_m, ceiling_m = self._floor_and_ceiling_m(low, high)
        if asset.bounds_m is None:
            _require_size("width", float((high - low).max()), asset)
            if np.isfinite(ceiling_m):
                _require_size("height inside", ceiling_m - floor_m, asset)
        if np.isfinite(ceiling_m):
            return bounds_m, np.stack([low, [*high[:2], ceiling_m - 0.01]])
        bounds_m[1, 2] += _OPEN_SKY_M
        return bounds_m, np.stack([low, high + np.array([0.0, 0.0, 0.01])])

    def _floor_and_ceiling_m(self, low: Array, high: Array) -> tuple[float, float]:
        """Return the heights of the lowest floor and the highest ceiling; outdoors infinity.

        Going up, a floor is the first face that looks up, and a ceiling the next that looks down.
        """
        across, along = np.meshgrid(
            *((np.arange(_GRID) + 0.5) / _GRID * (high - low)[axis] + low[axis] for axis in (0, 1))
        )
        bottom = np.full(across.size, low[2] - 1.0)
        at = self._to_blender(np.stack([across.ravel(), along.ravel(), bottom], axis=1))
        upwards = np.broadcast_to([0.0, 0.0, 1.0], at.shape)
        floors, ceilings = np.full((2, len(at)), np.inf)
        for _ in range(_MOST_LAYERS):
            distances, turned = self.triangles.first_hits(at, upwards)
            is_met = np.isfinite(distances)
            if not is_met.any():
                break
            at[is_met, 2] += distances[is_met]
            is_floor = (turned > 0) & np.isinf(floors)
            is_ceiling = (turned < 0) & np.isfinite(floors) & np.isinf(ceilings)
            floors[is_floor], ceilings[is_ceiling] = at[is_floor, 2], at[is_ceiling, 2]
            at[:, 2] += 1e-5 / self.unit_m
        found = ceilings[np.isfinite(floors)]
        if not found.size or np.isinf(found).mean() > _OPEN_SHARE:
            return float(low[2]), math.inf
        ceiling = float(found[np.isfinite(found)].max())
        return float(floors.min()) * self.unit_m, ceiling * self.unit_m

    def cast(self, asked: Asked, origins_m: Array, directions: Array) -> Array:
        """Return how many metres each ray goes until it meets the map."""
        ways = directions * _FLIP
        distances, _ = self.triangles.first_hits(self._to_blender(origins_m), ways)
        return distances * self.unit_m

    def _to_blender(self, points_m: Array) -> Array:
        """Return points of map axes in Blender's axes and the file's units."""
        return points_m * _FLIP / self.unit_m

    def facts(self, asked: Asked, frames: int) -> tuple[Array, Array, Array, list[str]]:
        """Return bounds, those of spawns, the subject's points (frames, p, 3), and notes."""
        subject = self._subject_of(asked)
        points_m = np.stack([subject.points_m(frame) for frame in range(frames)])
        return self.bounds_m, self.spawn_bounds_m, points_m, self.notes

    def _subject_of(self, asked: Asked) -> Subject:
        """Put a character with an animation into the scene, in place of the one before."""
        _, _, character, animation = asked
        if self.subject is None or self._subject_assets != (character, animation):
            self.subject = None
            for kind in (bpy.data.objects, bpy.data.actions):
                for added in set(kind) - self._own:
                    kind.remove(added)
            bpy.data.orphans_purge(do_recursive=True)
            self.subject = Subject(character, animation, root=self.root, unit_m=self.unit_m)
            self._subject_assets = character, animation
        return self.subject

    def render(self, asked: Asked, shot: Shot) -> Array:
        """Write the pictures of several cameras at a frame; return their depths in metres."""
        subject = self._subject_of(asked)
        time_frames, times = subject.time_of(shot.frame)
        exact = self.start + shot.frame / _RATE_HZ * self.rate_hz
        self.scene.frame_set(int(exact), subframe=exact - int(exact))
        place = self._to_blender(shot.spawn.place_m)
        subject.place((place, 90.0 - shot.spawn.yaw_deg), time_frames=time_frames, times=times)
        self.scene.frame_set(int(exact), subframe=exact - int(exact))
        eyes = [self._to_blender(view.eye) for view in shot.views]
        turned = [view.axes * _FLIP[:, None] for view in shot.views]
        width_px, height_px = shot.views[0].size_px
        self._set_render(shot)
        self._set_cameras(shot, eyes=eyes, axes=turned)
        bpy.ops.render.render(write_still=True)
        depths = self._depths(width_px, height_px)
        return np.where(depths < _NOTHING, depths * self.unit_m, np.inf)

    def _depths(self, width_px: int, height_px: int) -> Array:
        """Return Cycles' depth along the axis (cameras, h, w), of the frame that is set."""
        cycles, layer = self.scene.cycles, bpy.context.view_layer
        cycles.samples, cycles.use_denoising, cycles.filter_width = 1, False, _NARROWEST_PX
        layer.use_pass_z, layer.pass_alpha_threshold = True, 0.5
        found: dict[int, Array] = {}

        def read(engine: Any) -> None:
            for each in engine.get_result().layers[layer.name].passes:
                if each.name == "Depth":
                    found[each.view_id] = np.empty(width_px * height_px, np.float32)
                    each.rect.foreach_get(found[each.view_id])

        _render(after=read)
        layer.use_pass_z = False
        passes = np.stack([found[view] for view in sorted(found)]).astype(np.float64)
        # Blender's first row is the lowest.
        return passes.reshape(-1, height_px, width_px)[:, ::-1]

    def _set_render(self, shot: Shot) -> None:
        settings = shot.settings
        scene, cycles = self.scene, self.scene.cycles
        render = scene.render
        render.engine = "CYCLES"
        render.resolution_x, render.resolution_y = shot.views[0].size_px
        render.filepath = str(shot.folder / "view")
        render.use_file_extension = render.use_overwrite = True
        image = render.image_settings
        image.media_type = "IMAGE"
        image.file_format, image.color_mode, image.color_depth = "PNG", "RGB", "8"
        image.compression = 0
        image.views_format = "INDIVIDUAL"
        cycles.samples = settings.samples_per_pixel
        cycles.seed, cycles.use_animated_seed = shot.seed, False
        cycles.use_adaptive_sampling = False
        cycles.time_limit = 0.0
        cycles.use_denoising = settings.denoise
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.shading_system = False
        cycles.use_auto_tile = False
        cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 1.5
        cycles.device = _device(settings)
        render.threads_mode = "FIXED" if settings.threads else "AUTO"
        if settings.threads:
            render.threads = settings.threads

    def _set_cameras(self, shot: Shot, *, eyes: list[Array], axes: list[Array]) -> None:
        """Make one camera a view, whose pictures Cycles writes in one render."""
        scene, render = self.scene, self.scene.render
        (width_px, _), (fx, fy) = shot.views[0].size_px, shot.views[0].focal_px
        render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, fy / fx), max(1.0, fx / fy)
        render.use_multiview = True
        render.views_format = "MULTIVIEW"
        for view in list(render.views):
            view.use = False
        for number, (eye, axis) in enumerate(zip(eyes, axes, strict=True)):
            name = f"stereogenbench_{number}"
            item = bpy.data.objects.get(name)
            if item is None:
                item = bpy.data.objects.new(name, bpy.data.cameras.new(name))
                scene.collection.objects.link(item)
            forward, right, up = axis.T
            matrix = np.eye(4)
            matrix[:3, :4] = np.stack([right, up, -forward, eye], axis=1)
            item.matrix_world = Matrix(matrix.tolist())
            camera = item.data
            camera.type, camera.sensor_fit = "PERSP", "HORIZONTAL"
            camera.sensor_width = 36.0
            camera.lens = fx * 36.0 / width_px
            camera.shift_x = camera.shift_y = 0.0
            camera.clip_start, camera.clip_end = 1e-3 / self.unit_m, 1e6
            camera.dof.use_dof = False
            view = render.views.get(name) or render.views.new(name)
            view.camera_suffix, view.use = f"_{number}", True
            if number == 0:
                scene.camera = item


def _device(settings: RenderSettings) -> str:
    """Return Cycles' name of a device, and switch it on."""
    if settings.device == "CPU":
        return "CPU"
    preferences = bpy.context.preferences.addons["cycles"].preferences
    kinds = {each[0] for each in preferences.get_device_types(bpy.context)}
    for kind in filter(kinds.__contains__, _GPU_KINDS):
        preferences.compute_device_type = kind
        preferences.refresh_devices()
        if any(device.type == kind for device in preferences.devices):
            for device in preferences.devices:
                device.use = device.type == kind
            return "GPU"
    raise SynthesisError(
        'device = "GPU": Cycles finds no GPU here. Install the driver of the GPU, or set '
        'device = "CPU" in [render].'
    )

"""Make a tiny asset set with Blender: a yard, a room and a walking figure; kilobytes in all.

Run it with a Python that has bpy: ``python make_blender_assets.py FOLDER``.
"""

import math
import random
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

RATE_HZ = 24


def clear():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = RATE_HZ


def box(name, size, centre, material, *, turn_deg=0.0):
    turn = (0, 0, math.radians(turn_deg))
    bpy.ops.mesh.primitive_cube_add(size=1, location=centre, scale=size, rotation=turn)
    return finished(name, material)


def ball(name, radius, centre, material):
    bpy.ops.mesh.primitive_uv_sphere_add(segments=12, ring_count=8, radius=radius, location=centre)
    return finished(name, material)


def finished(name, material):
    """Name the object that was added, and lay texture coordinates in metres onto its faces."""
    bpy.ops.object.transform_apply(location=False, rotation=False)
    made, mesh = bpy.context.object, bpy.context.object.data
    made.name = name
    mesh.materials.append(material)
    layer = mesh.uv_layers.active or mesh.uv_layers.new()
    for face in mesh.polygons:
        drop = max(range(3), key=lambda axis: abs(face.normal[axis]))
        keep = [axis for axis in range(3) if axis != drop]
        for corner in face.loop_indices:
            place = mesh.vertices[mesh.loops[corner].vertex_index].co
            layer.data[corner].uv = (place[keep[0]] / 2, place[keep[1]] / 2)
    return made


def matte(name, colour):
    """A matte material without a picture."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*colour, 1)
    shader.inputs["Roughness"].default_value = 1.0
    shader.inputs["Specular IOR Level"].default_value = 0.0
    return material


def pictured(name, colour, *, folder, seed):
    """A matte material with a small picture, which files of all kinds can hold."""
    side = 64
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(0.35, 1.0, (8, 8))
    fine = np.kron(coarse, np.ones((side // 8, side // 8))) * rng.uniform(0.8, 1.0, (side, side))
    pixels = np.ones((side, side, 4), np.float32)
    pixels[..., :3] = fine[..., None] * colour
    image = bpy.data.images.new(name, side, side)
    image.pixels.foreach_set(pixels.ravel())
    image.filepath_raw = str(folder / f"{name}.png")
    image.file_format = "PNG"
    image.save()
    material = matte(name, colour)
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    shader = material.node_tree.nodes["Principled BSDF"]
    material.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    return material


def lamp(name, kind, centre, *, energy, **settings):
    light = bpy.data.lights.new(name, kind)
    light.energy = energy
    for key, value in settings.items():
        setattr(light, key, value)
    made = bpy.data.objects.new(name, light)
    made.location = centre
    bpy.context.scene.collection.objects.link(made)
    return made


def make_yard(folder):
    """An open ground with crates, balls and posts under a sun."""
    clear()
    rng = random.Random(7)
    ground, walls, crates = (
        pictured(name, colour, folder=folder, seed=seed)
        for seed, (name, colour) in enumerate(
            [("ground", (0.45, 0.4, 0.3)), ("wall", (0.6, 0.35, 0.25)), ("crate", (0.3, 0.45, 0.6))]
        )
    )
    box("ground", (40, 40, 0.2), (0, 0, -0.1), ground)
    for number, (centre, size) in enumerate(
        [((0, 12, 2), (24, 0.4, 4)), ((0, -12, 2), (24, 0.4, 4)), ((12, 0, 2), (0.4, 24, 4))]
    ):
        box(f"wall{number}", size, centre, walls)
    for number in range(10):
        angle, away = 2 * math.pi * number / 10 + rng.uniform(-0.2, 0.2), rng.uniform(5, 9)
        side = rng.uniform(0.5, 1.4)
        centre = (away * math.cos(angle), away * math.sin(angle), side / 2)
        if number % 3:
            box(f"crate{number}", (side,) * 3, centre, crates, turn_deg=rng.uniform(0, 90))
        else:
            ball(f"ball{number}", side / 2, centre, crates)
    for number in range(4):
        box(f"post{number}", (0.12, 0.12, 2.6), (rng.uniform(-8, 8), rng.uniform(4, 9), 1.3), walls)
    sun = lamp("sun", "SUN", (0, 0, 10), energy=3.0, angle=math.radians(3))
    sun.rotation_euler = (math.radians(35), math.radians(15), 0.4)
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (0.6, 0.75, 1.0, 1)
    background.inputs["Strength"].default_value = 0.7
    bpy.context.scene.world = world
    bpy.context.scene.view_settings.view_transform = "Standard"
    fan = box("fan", (1.6, 0.1, 0.3), (-3, 11, 2.5), crates)
    fan.rotation_euler = (0, 0, 0)
    fan.keyframe_insert("rotation_euler", frame=1)
    fan.rotation_euler = (0, math.radians(180), 0)
    fan.keyframe_insert("rotation_euler", frame=49)
    bpy.ops.file.pack_all()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "yard.blend"), compress=True)


def make_room(folder):
    """A closed room with furniture and two lamps, as one .glb file."""
    clear()
    wall = pictured("wall", (0.75, 0.7, 0.6), folder=folder, seed=1)
    wood = pictured("wood", (0.6, 0.4, 0.25), folder=folder, seed=2)
    box("floor", (9, 7, 0.2), (0, 0, -0.1), wood)
    box("ceiling", (9, 7, 0.2), (0, 0, 3.3), wall)
    for number, (centre, size) in enumerate(
        [((4.6, 0, 1.6), (0.2, 7, 3.2)), ((-4.6, 0, 1.6), (0.2, 7, 3.2)),
         ((0, 3.6, 1.6), (9, 0.2, 3.2)), ((0, -3.6, 1.6), (9, 0.2, 3.2))]
    ):  # fmt: skip
        box(f"wall{number}", size, centre, wall)
    box("table", (1.6, 0.8, 0.75), (2.8, 2.2, 0.375), wood)
    box("shelf", (0.4, 2.0, 2.0), (-4.2, 1.0, 1.0), wood)
    ball("globe", 0.3, (2.8, 2.2, 1.05), wood)
    for x in (-2.0, 2.0):
        lamp(f"lamp{x}", "POINT", (x, 0, 2.9), energy=150.0, shadow_soft_size=0.3)
    bpy.ops.export_scene.gltf(
        filepath=str(folder / "room.glb"), export_lights=True, export_format="GLB"
    )


def glowing(name, colour):
    """A material of one colour, whatever the light."""
    material = matte(name, colour)
    nodes = material.node_tree.nodes
    glow = nodes.new("ShaderNodeEmission")
    glow.inputs["Color"].default_value = (*colour, 1)
    material.node_tree.links.new(glow.outputs[0], nodes["Material Output"].inputs["Surface"])
    return material


def make_screen(folder):
    """A red card with holes, half a metre wide, before a blue wall and the open sky."""
    clear()
    bpy.context.scene.view_settings.view_transform = "Standard"
    box("floor", (16, 16, 0.2), (0, 0, -0.1), glowing("green", (0, 0.5, 0)))
    box("wall", (0.2, 5, 6), (6, 2.5, 3), glowing("blue", (0, 0, 1)))
    red = glowing("red", (1, 0, 0))
    nodes, links = red.node_tree.nodes, red.node_tree.links
    place, checker = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeTexChecker")
    checker.inputs["Scale"].default_value = 2.0
    holes, mix = nodes.new("ShaderNodeBsdfTransparent"), nodes.new("ShaderNodeMixShader")
    links.new(place.outputs["Object"], checker.inputs["Vector"])
    links.new(checker.outputs["Fac"], mix.inputs["Fac"])
    links.new(holes.outputs[0], mix.inputs[1])
    links.new(nodes["Emission"].outputs[0], mix.inputs[2])
    links.new(mix.outputs[0], nodes["Material Output"].inputs["Surface"])
    # Off the plane where the checker's squares meet.
    bpy.ops.mesh.primitive_plane_add(size=1, location=(0.05, 0, 1.5), rotation=(0, math.pi / 2, 0))
    bpy.context.object.scale = (3, 4, 1)
    bpy.ops.object.transform_apply()
    bpy.context.object.location = (2, 0, 0.5)
    bpy.context.object.data.materials.append(red)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "screen.blend"), compress=True)


BONES = {
    "hips": (None, (0, 0, 0.95), (0, 0, 1.1), 0.16),
    "spine": ("hips", (0, 0, 1.1), (0, 0, 1.48), 0.17),
    "head": ("spine", (0, 0, 1.52), (0, 0, 1.75), 0.1),
    "thigh.L": ("hips", (0.1, 0, 0.95), (0.1, 0, 0.5), 0.085),
    "shin.L": ("thigh.L", (0.1, 0, 0.5), (0.1, 0, 0.05), 0.06),
    "thigh.R": ("hips", (-0.1, 0, 0.95), (-0.1, 0, 0.5), 0.085),
    "shin.R": ("thigh.R", (-0.1, 0, 0.5), (-0.1, 0, 0.05), 0.06),
    "arm.L": ("spine", (0.23, 0, 1.45), (0.23, 0, 1.15), 0.05),
    "hand.L": ("arm.L", (0.23, 0, 1.15), (0.23, 0, 0.85), 0.045),
    "arm.R": ("spine", (-0.23, 0, 1.45), (-0.23, 0, 1.15), 0.05),
    "hand.R": ("arm.R", (-0.23, 0, 1.15), (-0.23, 0, 0.85), 0.045),
}
"""Parent, head, tail and radius of each bone."""


def make_figure(folder):
    """A figure that faces -y, with the takes Walk (moves on), Turn and Fall (ends elsewhere)."""
    clear()
    cloth = pictured("cloth", (0.7, 0.3, 0.3), folder=folder, seed=3)
    parts = []
    for name, (_, head, tail, radius) in BONES.items():
        head, tail = Vector(head), Vector(tail)
        bpy.ops.mesh.primitive_cylinder_add(
            vertices=8, radius=radius, depth=(tail - head).length, location=(head + tail) / 2
        )
        parts.append(bpy.context.object)
        whole = list(range(len(parts[-1].data.vertices)))
        parts[-1].vertex_groups.new(name=name).add(whole, 1.0, "REPLACE")
    for part in parts:
        part.select_set(state=True)
    bpy.ops.object.join()
    bpy.ops.object.transform_apply()
    body = finished("body", cloth)
    frame = bpy.data.armatures.new("skeleton")
    rig = bpy.data.objects.new("skeleton", frame)
    bpy.context.scene.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    for name, (parent, head, tail, _) in BONES.items():
        bone = frame.edit_bones.new(name)
        bone.head, bone.tail = head, tail
        bone.parent = frame.edit_bones[parent] if parent else None
    bpy.ops.object.mode_set(mode="OBJECT")
    body.parent = rig
    body.modifiers.new("armature", "ARMATURE").object = rig
    for pose in rig.pose.bones:
        pose.rotation_mode = "XYZ"
    walk = take(rig, "Walk", 25, lambda part: walking(part) | {"root": (0, -1.3 * part, 0)})
    turn = take(rig, "Turn", 49, lambda part: {"arm.L": 150 * math.sin(math.pi * part) ** 2})
    fall = take(rig, "Lean", 25, lambda part: {"spine": 50 * part, "arm.R": -60 * part})
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "figure.blend"), compress=True)
    extra = [box("plinth", (1, 1, 0.4), (0, 0, -0.2), cloth), ball("widget", 0.8, (0, 0, 1), cloth)]
    hidden = bpy.data.collections.new("widgets")
    bpy.context.scene.collection.children.link(hidden)
    hidden.objects.link(extra[1])
    bpy.context.scene.collection.objects.unlink(extra[1])
    bpy.context.view_layer.layer_collection.children["widgets"].exclude = True
    rig.pose.bones["hips"].custom_shape = extra[1]
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "figure_extra.blend"), compress=True)
    rig.pose.bones["hips"].custom_shape = None
    for made in extra:
        bpy.data.objects.remove(made)
    rig.animation_data.action = None
    for action in (walk, turn, fall):
        track = rig.animation_data.nla_tracks.new()
        track.name = action.name
        track.strips.new(action.name, 1, action)
    bpy.ops.export_scene.gltf(
        filepath=str(folder / "figure.glb"),
        export_format="GLB",
        export_animation_mode="NLA_TRACKS",
    )
    bpy.ops.export_scene.fbx(
        filepath=str(folder / "figure.fbx"),
        object_types={"ARMATURE", "MESH"},
        bake_anim_use_all_actions=False,
        bake_anim_use_nla_strips=True,
        path_mode="COPY",
        embed_textures=True,
        add_leaf_bones=False,
    )


def walking(part):
    swing = math.sin(2 * math.pi * part)
    return {
        "thigh.L": 28 * swing,
        "thigh.R": -28 * swing,
        "shin.L": -18 * (1 + math.sin(2 * math.pi * part - 1.2)),
        "shin.R": -18 * (1 - math.sin(2 * math.pi * part - 1.2)),
        "arm.L": -22 * swing,
        "arm.R": 22 * swing,
        "hand.L": 12,
        "hand.R": 12,
    }


def take(rig, name, frames, pose_of):
    rig.animation_data_create()
    action = bpy.data.actions.new(name)
    rig.animation_data.action = action
    for frame in range(1, frames + 1, 2):
        pose = pose_of((frame - 1) / (frames - 1))
        for bone in rig.pose.bones:
            bone.rotation_euler = (math.radians(pose.get(bone.name, 0)), 0, 0)
            bone.keyframe_insert("rotation_euler", frame=frame)
        hips = rig.pose.bones["hips"]
        step = Vector(pose.get("root", (0, 0, 0)))
        hips.location = hips.bone.matrix_local.to_3x3().inverted() @ step
        hips.keyframe_insert("location", frame=frame)
    for bone in rig.pose.bones:
        bone.matrix_basis = Matrix.Identity(4)
    action.use_fake_user = True
    return action


ASSETS = """\
[maps.Yard]
file = "yard.blend"
spawn_bounds_m = [[-3.0, -3.0, -0.5], [3.0, 3.0, 1.0]]

[maps.Room]
file = "room.glb"

[characters.Figure]
file = "figure.glb"

[animations.Walk]
file = "figure.glb"
take = "Walk"

[animations.Wave]
file = "figure.fbx"
take = "Turn"

[render]
samples_per_pixel = 32
"""


def make_broken(folder):
    """Maps and characters that each have one fault, and what they refer to outside the folder."""
    outside = folder.parent / "outside"
    outside.mkdir(exist_ok=True)

    def save(name):
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / name), compress=True)

    def lit_floor(textures=None):
        clear()
        lamp("sun", "SUN", (0, 0, 5), energy=2.0)
        colour = (0.5, 0.5, 0.5)
        material = (
            pictured("far", colour, folder=textures, seed=1) if textures else matte("plain", colour)
        )
        box("floor", (8, 8, 0.2), (0, 0, -0.1), material)

    lit_floor()
    bpy.context.scene.objects["floor"].hide_render = True
    save("empty.blend")
    lit_floor()
    bpy.context.scene.objects["floor"].scale = (10000.0,) * 3
    save("huge.blend")
    lit_floor(textures=outside)
    save("far_texture.blend")

    lit_floor()
    script = bpy.data.texts.new("harm.py")
    script.write(f"open({str(outside / 'was_run')!r}, 'w').close()")
    script.use_module = True
    floor = bpy.context.scene.objects["floor"]
    driver = floor.driver_add("location", 2).driver
    driver.type = "SCRIPTED"
    driver.expression = f"open({str(outside / 'was_driven')!r}, 'w').close() or 3.0"
    simple = floor.driver_add("location", 0).driver
    simple.type = "SCRIPTED"
    simple.expression = "frame * 0"
    save("scripted.blend")
    for made in outside.glob("was_*"):
        made.unlink()

    lit_floor()
    save("boneless.blend")
    (folder / "cut.blend").write_bytes((folder / "boneless.blend").read_bytes()[:300])
    (folder / "cut.fbx").write_bytes(b"Kaydara FBX Binary  \x00\x1a\x00" + b"x" * 50)

    clear()
    other = bpy.data.armatures.new("other")
    rig = bpy.data.objects.new("other", other)
    bpy.context.scene.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    bone = other.edit_bones.new("Bip01")
    bone.head, bone.tail = (0, 0, 0), (0, 0, 1)
    bpy.ops.object.mode_set(mode="OBJECT")
    rig.pose.bones["Bip01"].keyframe_insert("location", frame=1)
    rig.pose.bones["Bip01"].keyframe_insert("location", frame=9)
    save("other_bones.blend")


if __name__ == "__main__":
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    make_yard(out)
    make_room(out)
    make_figure(out)
    make_screen(out)
    make_broken(out)
    (out / "assets.toml").write_text(ASSETS)

"""The built-in renderer: the built-in maps, drawn by casting rays."""

from collections.abc import Iterator
from dataclasses import dataclass

from stereogenbench_data.synthesis.maps import ANIMATIONS, CHARACTERS, MAPS, RayWorld, open_map
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.render import SceneState, render_frame, static_light
from stereogenbench_data.synthesis.renderer import RenderedView, ScenePlan
from stereogenbench_data.synthesis.request import SENSOR_MM


@dataclass(frozen=True, slots=True)
class RayCasting:
    """The built-in renderer; see `Renderer`."""

    name: str = "ray-casting"
    maps: tuple[str, ...] = MAPS
    characters: tuple[str, ...] = CHARACTERS
    animations: tuple[str, ...] = ANIMATIONS
    sensors_mm: tuple[tuple[float, float], ...] = (SENSOR_MM,)
    fingerprint: str = "1"
    cameras_per_task: int = 1

    def world(self, proposal: Proposal) -> RayWorld:
        """See `Renderer.world`. A map of the release is a stage."""
        return open_map(proposal)

    def views(self, plan: ScenePlan, *, cameras: tuple[int, ...]) -> Iterator[RenderedView]:
        """See `Renderer.views`."""
        world = open_map(plan.proposal)
        light = static_light(world.scene)
        for frame in range(plan.request.frames):
            state = SceneState(
                world.scene, walker=world.limbs(plan.spawn, frame=frame), static_light=light
            )
            for camera in cameras:
                yield RenderedView(*render_frame(state, view=plan.view(camera=camera, frame=frame)))

    def description(self, plan: ScenePlan) -> dict[str, object]:
        """See `Renderer.description`."""
        scene = open_map(plan.proposal).scene
        ground, walls = scene.ground.texture, scene.static_shapes[0].material.texture
        things = len(scene.static_shapes)
        place = (
            "room"
            if any(
                shape.centre[2] - shape.half_m[2] > 2
                for shape in scene.static_shapes[: scene.shell]
            )
            else "yard"
        )
        detailed = (
            f"A figure walks over a ground of {ground}, among crates, balls and poles ({things} "
            f"things in all), before walls of {walls}."
        )
        return {
            "scene_type": "indoor" if place == "room" else "outdoor",
            "setting": place,
            "primary_elements": ["figure", "crates", "balls", "poles", "walls"],
            "spatial_layout": "a figure in the middle, things scattered around it",
            "lighting_materials": "sunlight, matte procedural textures",
            "short_caption": f"A figure walks over {ground}.",
            "detailed_caption": detailed,
            "tags": [place, "figure", ground, walls],
        }


RAY_CASTING = RayCasting()

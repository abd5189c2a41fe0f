"""Write the triangles of a .blend file at a frame, as Blender evaluates it for its windows.

Run it by ``python blender_truth.py FILE FRAME OUT.npz``.
"""

import sys

import bpy
import numpy as np

blend, frame, out = sys.argv[1], float(sys.argv[2]), sys.argv[3]
bpy.ops.wm.open_mainfile(filepath=blend, use_scripts=False)
scene = bpy.context.scene
scene.frame_set(int(frame), subframe=frame - int(frame))
depsgraph = bpy.context.evaluated_depsgraph_get()
corners = []
for item in scene.objects:
    if item.type == "MESH" and not item.hide_render:
        shown = item.evaluated_get(depsgraph)
        mesh = shown.to_mesh()
        mesh.calc_loop_triangles()
        for triangle in mesh.loop_triangles:
            corners.append(
                [shown.matrix_world @ mesh.vertices[number].co for number in triangle.vertices]
            )
np.savez(out, corners=np.array(corners, np.float64))

"""What a run can be exported to. Nothing heavy is loaded here: the command line reads it for its help."""

from __future__ import annotations

TRAJECTORIES = {
    "tum": "timestamp tx ty tz qx qy qz qw",
    "kitti": "12 numbers a row",
    "euroc": "CSV: nanoseconds, position, quaternion wxyz",
    "ros": "a folder with a ROS 2 bag",
}
PICTURES = {
    "colmap": "a folder with images, masks and sparse/0",
    "nerfstudio": "a folder with images, masks and transforms.json",
    "plates": "a folder with the photographs, what moves replaced by the splat",
}
SPLATS = {"spz": "the splat in a small file", "flight": "an .mp4", "depth": "a folder of 16-bit images, one a frame"}
DENSE = {"cloud": "a .ply with normals, a point wherever views agree", "mesh": "triangles, .ply or .glb"}
UNDISTORTING = ("colmap", "nerfstudio")  # write the lens with their images
KINDS = {**TRAJECTORIES, **PICTURES, **SPLATS, **DENSE}

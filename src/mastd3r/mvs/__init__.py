"""Multi-view stereo with known poses: depth of every pixel of a keyframe, its fusion to a cloud and to a mesh."""

"""A pointmap provider of your own, in one file and one registration line: dark frames are equalised before matching.

usage: python examples/04_own_pointmaps.py SEQUENCE OUT
"""

import sys
from dataclasses import replace

import cv2

import mastd3r
from mastd3r.config import with_override
from mastd3r.pointmap.geometric import GeometricPointmaps, working_size
from mastd3r.registry import POINTMAPS


class Equalised(GeometricPointmaps):
    """See ``mastd3r.protocols.PointmapProvider`` for all that a provider may say."""

    name = "equalised"

    def look(self, frame):
        lab = cv2.cvtColor(frame.image, cv2.COLOR_RGB2LAB)
        lab[..., 0] = cv2.createCLAHE(2.0, (8, 8)).apply(lab[..., 0])
        return super().look(replace(frame, image=cv2.cvtColor(lab, cv2.COLOR_LAB2RGB)))


def build(config, source):
    return Equalised(*working_size(*source.size, config.tracking.area_px), config.tracking.cell_px)


POINTMAPS.register("equalised", build, "geometric, on images of equalised contrast")

if __name__ == "__main__":
    config = with_override(mastd3r.Config(pointmaps="equalised"), "mapping.enabled=false")
    rec = mastd3r.reconstruct(sys.argv[1], sys.argv[2], config)
    print(f"{len(rec.poses)} poses in {rec.path}")

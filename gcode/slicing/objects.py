"""Which bodies of a solid lie apart in plan, so that one of them can be given up alone.

They are labelled in the job by the comments of PrusaSlicer and OrcaSlicer, which no firmware reads
and every host does (`gcode.reader.objects`).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gcode.meshes import ClosedMesh
from gcode.moves import Comment
from gcode.slicing.pen import Pen

Box = tuple[float, float, float, float]
NO_OBJECT = -1


def boxes_apart_mm(solid: ClosedMesh, gap_mm: float) -> tuple[Box, ...]:
    """(x_min, y_min, x_max, y_max) of bodies with a gap between them, from left to right.

    What lies nearer to each other, in plan, is one. None where the solid is one in this sense.
    """
    boxes = [np.array([*box[:2], *box[3:5]]) for box in solid.bodies_mm()]
    found: list[Float[np.ndarray, " 4"]] = []
    while boxes:
        box = boxes.pop()
        near = [k for k, other in enumerate(found) if _near(box, other, gap_mm)]
        if not near:
            found.append(box)
            continue
        for k in reversed(near):
            other = found.pop(k)
            box = np.concatenate([np.minimum(box, other)[:2], np.maximum(box, other)[2:]])
        boxes.append(box)
    if len(found) < 2:
        return ()
    return tuple(sorted((x0, y0, x1, y1) for x0, y0, x1, y1 in np.array(found).tolist()))


def _near(one: Float[np.ndarray, " 4"], other: Float[np.ndarray, " 4"], gap_mm: float) -> bool:
    return bool((one[:2] <= other[2:] + gap_mm).all() and (other[:2] <= one[2:] + gap_mm).all())


class Labels:
    """Says in a job whose beads come next; nothing where all are one object's.

    Parameters
    ----------
    boxes_mm
        Of the objects, as `boxes_apart_mm` has them.
    """

    def __init__(self, boxes_mm: tuple[Box, ...]) -> None:
        self._boxes_mm, self._now = boxes_mm, NO_OBJECT

    def of_box(self, pen: Pen, box_mm: Box) -> None:
        """What is laid next lies within this box."""
        middle = np.array([box_mm[0] + box_mm[2], box_mm[1] + box_mm[3]]) / 2
        inside = (
            k
            for k, (x0, y0, x1, y1) in enumerate(self._boxes_mm)
            if x0 <= middle[0] <= x1 and y0 <= middle[1] <= y1
        )
        self._change(pen, next(inside, NO_OBJECT))

    def of_none(self, pen: Pen) -> None:
        """What is laid next is no object's."""
        self._change(pen, NO_OBJECT)

    def _change(self, pen: Pen, to: int) -> None:
        if to == self._now:
            return
        if self._now != NO_OBJECT:
            pen.add(Comment(f"stop printing object body_{self._now + 1}"))
        if to != NO_OBJECT:
            pen.add(Comment(f"printing object body_{to + 1}"))
        self._now = to

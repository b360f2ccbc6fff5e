"""The eight EXIF orientations, which relate an image as stored to the image as displayed."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Shaped
from torch import Tensor


@dataclass(frozen=True)
class Orientation:
    """The operations that turn the stored raster upright: mirror columns, mirror rows, then transpose."""

    mirrors_columns: bool = False
    mirrors_rows: bool = False
    transposes: bool = False

    @staticmethod
    def from_exif(code: int) -> Orientation:
        """Return the orientation of EXIF tag 0x0112 (CIPA DC-008, table 6); unknown codes mean an upright image."""
        return Orientation(*CODES.get(code, (False, False, False)))

    def upright(self, image: Shaped[Tensor, "sh sw *channels"]) -> Shaped[Tensor, "h w *channels"]:
        """Turn a stored image upright."""
        axes = [axis for axis, flips in ((0, self.mirrors_rows), (1, self.mirrors_columns)) if flips]
        turned = image.flip(axes) if axes else image
        return turned.transpose(0, 1).contiguous() if self.transposes else turned

    def upright_size(self, width: int, height: int) -> tuple[int, int]:
        """Return the width and height of the upright image for a stored image of this size."""
        return (height, width) if self.transposes else (width, height)


UPRIGHT = Orientation()

CODES = {
    1: (False, False, False),
    2: (True, False, False),
    3: (True, True, False),
    4: (False, True, False),
    5: (False, False, True),
    6: (False, True, True),  # the camera was turned by 90 degrees: most portrait photos
    7: (True, True, True),
    8: (True, False, True),
}
QUARTER_TURNS = tuple(Orientation(*CODES[code]) for code in (6, 8))
"""The orientations of a camera turned by 90 degrees to one side and to the other."""

"""Figures that show themselves in a notebook."""

import io

from matplotlib.figure import Figure as _Figure


class Figure(_Figure):
    """A figure of matplotlib that a notebook shows, whether it has loaded pyplot or not."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png")
        return file.getvalue()

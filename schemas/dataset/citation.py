"""The article that the layout and the geometry follow, as every page that a dataset carries cites it."""

from typing import Final

ARTICLE: Final = (
    "R. Staszak and D. Belter, *3D object reconstruction: A comprehensive view-dependent dataset*, Data in Brief 55 "
    "(2024) 110569, https://doi.org/10.1016/j.dib.2024.110569, CC BY"
)

"""Region ids: the pixel values of segment images; objects count from REGION_FIRST_OBJECT."""

REGION_NOTHING = 0
REGION_FLOOR = 1
REGION_TABLE = 2
REGION_FIRST_OBJECT = 3

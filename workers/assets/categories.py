"""The category names of assets: the job's categories of objects, and tables."""

from schemas.job.job import CATEGORIES

TABLE = "table"
ASSET_CATEGORIES = (*CATEGORIES, TABLE)

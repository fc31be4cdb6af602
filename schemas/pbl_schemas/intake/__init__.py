"""Registration of recordings and of what belongs to them: `register` and the records that it takes."""

from __future__ import annotations

from .markers import LaboratoryMarkers
from .records import Methods, Recording, Registered, VisitRecord
from .registration import register
from .sensors import Sensors
from .videos import OneCamera, SeveralCameras, ingest

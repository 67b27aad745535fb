"""A map on disk: one SQLite file that remembers plants over sessions.

Reading is all that most callers want::

    from cluster_slam.io.map import open_map

    with open_map("field.map") as store:
        for plant in store.plants():  # PlantMap records, see cluster_slam.records
            print(plant.name, plant.cluster_ids, plant.clusters, plant.flowers, plant.flower_presence)
        row3 = store.plant("row3")  # one by name; InputError where there is none

``cluster_slam.constellation.growth.at(row3, stamp)`` then moves it to a date: drift and growth applied, covariances
grown since each cluster was last seen.
"""

from cluster_slam.io.map.store import MapStore, create_map, open_map

__all__ = ["MapStore", "create_map", "open_map"]

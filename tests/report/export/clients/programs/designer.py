"""CommonRoad's scenario designer converts OpenDRIVE files: how the lanelets of each are
linked, and their limits."""

import json
import logging
import sys

from crdesigner.map_conversion.map_conversion_interface import opendrive_to_commonroad

logging.disable(logging.CRITICAL)
for file in sys.argv[1:]:
    network = opendrive_to_commonroad(file).lanelet_network
    found = {
        "forks": sorted(
            len(lanelet.successor)
            for lanelet in network.lanelets
            if len(lanelet.successor) > 1
        ),
        "merges": sorted(
            len(lanelet.predecessor)
            for lanelet in network.lanelets
            if len(lanelet.predecessor) > 1
        ),
        "limits": sorted(
            {
                round(float(element.additional_values[0]), 2)
                for sign in network.traffic_signs
                for element in sign.traffic_sign_elements
                if element.additional_values
            }
        ),
    }
    print("answer:", json.dumps(found))

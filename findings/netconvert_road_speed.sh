#!/usr/bin/env bash
# netconvert reads the speed limit of a lane of an OpenDRIVE file and not that of its road.
#
# OpenDRIVE 1.7 gives a limit either for a road (type/speed, which holds for all of its lanes) or for a lane (lane/speed,
# which overrides it). netconvert drops the first without a warning, and the edge gets its default of 13.89 m/s.
# Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q eclipse-sumo==1.28.0

write() { # FILE ROAD_SPEED LANE_SPEED
  cat > "$1" <<XML
<?xml version="1.0"?>
<OpenDRIVE>
  <header revMajor="1" revMinor="7" name="limit" north="10" south="-10" east="110" west="-10"/>
  <road name="r" id="1" length="100" junction="-1" rule="RHT">
    <link/>
    <type s="0" type="town">$2</type>
    <planView><geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry></planView>
    <lanes><laneSection s="0">
      <center><lane id="0" type="none" level="false"/></center>
      <right><lane id="-1" type="driving" level="false"><link/><width sOffset="0" a="3.5" b="0" c="0" d="0"/>$3</lane></right>
    </laneSection></lanes>
  </road>
</OpenDRIVE>
XML
}
write "$folder/road.xodr" '<speed max="7.5" unit="m/s"/>' ''
write "$folder/lane.xodr" '' '<speed sOffset="0" max="7.5" unit="m/s"/>'
"$folder/venv/bin/netconvert" --version | sed -n 1p
for kind in road lane; do
  "$folder/venv/bin/netconvert" --opendrive-files "$folder/$kind.xodr" -o "$folder/$kind.net.xml"
  echo "limit of the $kind, 7.5 m/s: $(grep -o '<lane id="-1_0"[^>]*' "$folder/$kind.net.xml" | grep -o 'speed="[^"]*"')"
done
grep '<lane id="-1_0"' "$folder/road.net.xml" | grep -q 'speed="13.89"'
grep '<lane id="-1_0"' "$folder/lane.net.xml" | grep -q 'speed="7.50"'

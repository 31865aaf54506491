#!/bin/sh
# SPDX-License-Identifier: MIT
#
# `make bench-peers`: the surface z = .5 + .1 sin(2 pi x) sin(2 pi y) over [.15, .85]^2 into the unit
# cube by Gmsh (HXT, it meshes anew) and by us, in turn, one thread: CPU seconds of the whole
# process, medians of five, and both qualities.
# usage: bench_peers.sh MECCANO FOLDER
meccano=$1 folder=$2
command -v gmsh >/dev/null || { echo 'bench-peers: skipped, gmsh is not installed'; exit 0; }
mkdir -p "$folder"
cd "$folder" || exit 1

awk 'BEGIN { n = 64; pi = atan2(0, -1); print "solid s"
  for (i = 0; i < n; ++i) for (j = 0; j < n; ++j) { tri(i, j, i+1, j, i+1, j+1); tri(i, j, i+1, j+1, i, j+1) }
  print "endsolid s" }
  function v(i, j,  x, y) { x = .15 + .7*i/n; y = .15 + .7*j/n
    printf "vertex %.15g %.15g %.15g\n", x, y, .5 + .1*sin(2*pi*x)*sin(2*pi*y) }
  function tri(a, b, c, d, e, f) { print "facet normal 0 0 0\nouter loop"; v(a, b); v(c, d); v(e, f)
    print "endloop\nendfacet" }' > sine2.stl
cat > sine2.geo <<'GEO'
Merge "sine2.stl";
ClassifySurfaces{Pi, 1, 1, Pi/4};
CreateGeometry;
s() = Surface{:};
SetFactory("Built-in");
p = newp; l = newl;
For i In {0:1}
  Point(p+4*i) = {0,0,i}; Point(p+4*i+1) = {1,0,i}; Point(p+4*i+2) = {1,1,i}; Point(p+4*i+3) = {0,1,i};
  For k In {0:3}
    Line(l+4*i+k) = {p+4*i+k, p+4*i+(k+1)%4};
  EndFor
  Curve Loop(1000+i) = {l+4*i:l+4*i+3}; Plane Surface(1000+i) = {1000+i};
EndFor
For k In {0:3}
  Line(l+8+k) = {p+k, p+4+k};
EndFor
For k In {0:3}
  Curve Loop(1002+k) = {l+k, l+8+(k+1)%4, -(l+4+k), -(l+8+k)}; Plane Surface(1002+k) = {1002+k};
EndFor
Surface Loop(1) = {1000:1005}; Volume(1) = {1};
Surface{s()} In Volume{1};
Physical Volume(1) = {1}; Physical Surface(2) = {s()};
// h at the surface, growing by .3 of the distance up to .16
Field[1] = Distance; Field[1].FacesList = {s()}; Field[1].NNodesByEdge = 40;
Field[2] = Threshold; Field[2].IField = 1; Field[2].LcMin = h; Field[2].LcMax = .16;
Field[2].DistMin = h; Field[2].DistMax = h + (.16 - h)/.3;
Background Field = 2;
Mesh.CharacteristicLengthFromPoints = 0; Mesh.CharacteristicLengthExtendFromBoundary = 0;
Mesh.Algorithm3D = 10; Mesh.MshFileVersion = 2.2;
GEO
"$meccano" box --cells 5 5 5 -o cube.vtk > /dev/null

# CPU seconds of a command: times prints those of the children last, as 0m1.234s 0m0.5s
cpu() {
  "$@" > log.txt 2>&1 || { cat log.txt; exit 1; }
  times > times.txt
  tail -n 1 times.txt | awk '{ for (i = 1; i <= 2; ++i) { split($i, t, "m"); s += 60*t[1] + t[2] } print s }'
}
median() { sort -n | sed -n 3p; }
# Tetrahedra, and lowest and mean q: against the regular tetrahedron, for .msh keeps no other.
figures() {
  "$meccano" stats "$1" | awk '/^tetrahedra/ { n = $2 } /^min/ { lo = $2 } /^mean/ { me = $2 }
    END { print n, lo, me }'
}
echo '  tets  CPU s   us/tet  min/mean against the regular tetrahedron'
for pair in .02:.06 .01:.03; do
  h=${pair%:*} lc=${pair#*:}
  : > theirs.txt; : > ours.txt
  for run in 1 2 3 4 5; do
    (cpu gmsh -3 sine2.geo -nt 1 -setnumber h "0$h" -o gmsh.msh) >> theirs.txt
    (cpu "$meccano" insert cube.vtk sine2.stl --lc "$lc" --threads 1 -o ours.msh) >> ours.txt
  done
  { echo "$(median < theirs.txt) $(figures gmsh.msh) gmsh h=$h"
    echo "$(median < ours.txt) $(figures ours.msh) meccano l_c=$lc"; } |
    awk '{ us = 1e6*$1/$2; printf "%7d %6.2f %7.1f  %s / %s  %s %s", $2, $1, us, $3, $4, $5, $6
           if (NR == 2) printf "  ratio per tetrahedron %.2f", us/first; else first = us; print "" }'
done

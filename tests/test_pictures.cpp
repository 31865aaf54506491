// SPDX-License-Identifier: MIT
//
// main.cpp: the pictures of a mesh behind a cut, and the histogram of its quality.
#include <doctest/doctest.h>

#include <filesystem>
#include <fstream>
#include <iostream>
#include <set>
#include <sstream>

// A second copy of main.cpp in this executable, under a name of its own. The headers that speak of
// std::ios::app are above.
#define app app_of_pictures
#define MECCANO_NO_MAIN
#include "../main.cpp"
#undef app

#include "../samples/surfaces.hpp"

using namespace meccano;
using namespace meccano::app_of_pictures;

namespace {

struct PictureFolder {
  fs::path path = fs::temp_directory_path() / ("meccano-pictures-" + std::to_string(::getpid()));
  PictureFolder() { fs::create_directories(path); }
  ~PictureFolder() {
    std::error_code none;
    fs::remove_all(path, none);
  }
  std::string operator/(const std::string& name) const { return (path / name).string(); }
};

int statusOf(const std::vector<std::string>& words, std::string* err = nullptr,
             std::string* out = nullptr) {
  std::ostringstream outStream, errStream;
  const int status = run(words, {outStream, errStream, false});
  if (err) *err = errStream.str();
  if (out) *out = outStream.str();
  return status;
}

bool holds(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

int countOf(const std::string& text, const std::string& part) {
  int n = 0;
  for (std::size_t at = text.find(part); at != std::string::npos; at = text.find(part, at + 1)) ++n;
  return n;
}

/// Every tag is closed in order, every attribute quoted, every & an entity, no bare < in a text.
bool isWellFormed(const std::string& text) {
  std::vector<std::string> open;
  for (std::size_t at = 0; at < text.size();) {
    if (text[at] == '&') {
      const std::string entity = text.substr(at, text.find(';', at) + 1 - at);
      if (!std::set<std::string>{"&amp;", "&lt;", "&gt;", "&quot;"}.count(entity)) return false;
    }
    if (text[at] == '>') return false;
    if (text[at++] != '<') continue;
    const std::size_t end = text.find('>', at);
    const std::string tag = text.substr(at, end - at);
    if (end == std::string::npos || tag.find('<') != std::string::npos) return false;
    if (countOf(tag, "\"") != 2 * countOf(tag, "=")) return false;
    const std::string name =
        tag.substr(tag[0] == '/', tag.find_first_of(" /", 1) - (tag[0] == '/'));
    if (tag[0] == '/') {
      if (open.empty() || open.back() != tag.substr(1)) return false;
      open.pop_back();
    } else if (tag.back() != '/') {
      open.push_back(name);
    }
    at = end + 1;
  }
  return open.empty();
}

/// Triangles drawn: each "z" of a path ends one.
int drawnTriangles(const std::string& svg) { return countOf(svg, "zM") + countOf(svg, "z\"/>"); }

PictureOptions cutAt(int axis, double value, Colour colour = Colour::quality) {
  return {{axis, value}, colour, "m", {}};
}

/// The demo's mesh.
const Mesh& insertedMesh() {
  static const Mesh M = [] {
    Mesh mesh = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2});
    InsertOptions options;
    options.lc = .12;
    insertSurface(mesh, samples::sine(.1, 32), options);
    return mesh;
  }();
  return M;
}

}  // namespace

TEST_SUITE("pictures") {
  TEST_CASE("a cube behind the cut: the three sides turned to the eye, two faces each") {
    for (int axis = 0; axis < 3; ++axis) {
      CAPTURE(axis);
      std::array<int, 3> cells{1, 1, 1};
      cells[axis] = 2;
      const Mesh M = boxMesh({0, 0, 0}, {1. * cells[0], 1. * cells[1], 1. * cells[2]}, cells);
      const Drawing D = drawingOf(M, cutAt(axis, 1));
      CHECK(D.shown == 6);
      CHECK(D.facets.size() == 12);
      CHECK(D.visible == 6);
      const std::string svg = pictureText(M, cutAt(axis, 1));
      CHECK(drawnTriangles(svg) == 6);
      CHECK(holds(svg, "6 of 12 tetrahedra, 6 faces seen"));
      CHECK(isWellFormed(svg));
    }
  }

  TEST_CASE("shown are whole tetrahedra by their centres, on the far side of the eye") {
    const Mesh M = boxMesh({0, 0, 0}, {3, 3, 3}, {3, 3, 3});
    for (const Cut cut : {Cut{0, 1.}, Cut{1, 1.}, Cut{2, 1.}, Cut{1, 1.4}}) {
      CAPTURE(nameOf(cut));
      int expected = 0, shown = 0;
      for (const std::array<int, 4>& z : M.tets) {
        const Vec3 centre = .25 * (M.x[z[0]] + M.x[z[1]] + M.x[z[2]] + M.x[z[3]]);
        const double at = component(centre, cut.axis);
        expected += cut.axis == 1 ? at > cut.value : at < cut.value;
      }
      const std::vector<Facet> facets = facetsBehind(M, cut, false, shown);
      CHECK(shown == expected);
      Vec3 area;  // of a closed surface: zero
      for (const Facet& f : facets) {
        const std::array<int, 4>& z = M.tets[f.tet];
        Vec3 n = cross(M.x[f.nodes[1]] - M.x[f.nodes[0]], M.x[f.nodes[2]] - M.x[f.nodes[0]]);
        Vec3 inwards;
        for (int k : z) inwards += M.x[k] - M.x[f.nodes[0]];
        area += dot(n, inwards) > 0 ? -n : n;
      }
      CHECK(norm(area) < 1e-12);
    }
  }

  TEST_CASE("what lies behind something else is not drawn, and the nearer is painted later") {
    const Triangle3 far{{{0, 0, 5}, {40, 0, 5}, {0, 40, 5}}};
    const Triangle3 hidden{{{2, 2, 7}, {8, 2, 7}, {2, 8, 7}}};
    const Triangle3 near{{{20, 0, 1}, {60, 0, 1}, {20, 40, 1}}};
    const std::vector<Triangle3> seen{near, hidden, far};
    const ItemBuffer B = itemBuffer(seen, 64, 64);
    CHECK(B.item[3 * 64 + 3] == 2);
    CHECK(B.item[3 * 64 + 25] == 0);
    CHECK(B.item[60 * 64 + 60] == -1);
    CHECK(paintingLayers(seen, B) == std::vector<int>{1, -1, 0});
    // three that overlap in a circle: an order is found all the same
    auto bar = [](Vec3 a, Vec3 b, Vec3 c) { return Triangle3{a, b, c}; };
    const std::vector<Triangle3> circle{bar({0, 0, 0}, {60, 0, 9}, {60, 12, 9}),
                                        bar({60, 0, 0}, {60, 60, 9}, {48, 60, 9}),
                                        bar({60, 60, 0}, {0, 0, 9}, {10, 0, 9})};
    for (int layer : paintingLayers(circle, itemBuffer(circle, 64, 64))) CHECK(layer >= 0);
  }

  TEST_CASE("a box of 4 x 3 x 5 cells shows the outer squares of three sides only") {
    const Mesh M = boxMesh({-1, 2, 1e6}, {4, 3, 5}, {4, 3, 5});
    CHECK(drawingOf(M, cutAt(1, 3)).visible == 2 * (4 * 5 + 4 * 2 + 2 * 5));
    CHECK(drawingOf(M, cutAt(0, 1)).visible == 2 * (3 * 5 + 2 * 3 + 2 * 5));
    CHECK(drawingOf(M, cutAt(2, 1e6 + 2)).visible == 2 * (4 * 3 + 4 * 2 + 2 * 3));
  }

  TEST_CASE("the default cut crosses the surface, through its middle, on a plane of the cubes") {
    const Mesh box = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2});
    CHECK(nameOf(defaultCut({}, box)) == "y = 0.5");
    CHECK(nameOf(defaultCut(trianglesOf(samples::sine(.1)), box)) == "y = 0.5");
    TriangleSurface wall = samples::sine(.1);  // y = f(z), the middle x = .4
    for (Vec3& p : wall.points) p = {.4 + .8 * (p.y - .5), p.z, p.x};
    const Cut cut = defaultCut(trianglesOf(wall), box);
    CHECK(cut.axis == 0);
    CHECK(cut.value == .375);
    double length = 0;
    for (const Segment& s : sectionOf(trianglesOf(wall), cut)) {
      CHECK(s.a.x == doctest::Approx(cut.value));
      length += norm(s.b - s.a);
    }
    CHECK(length == doctest::Approx(.76).epsilon(.03));
  }

  TEST_CASE("legends: classes of q, levels with their numbers, surfaces with their names") {
    Mesh M = insertedMesh();
    M.surfaces[0].name = "a<b & \"c\"";
    const std::string byQuality = pictureText(M, cutAt(1, .5));
    for (const char* word : {">quality q<", ">0<", ">0.2<", ">1<", ">inverted<",
                             ">inserted surface<", "min 0.7", "inverted 0"})
      CHECK_MESSAGE(holds(byQuality, word), std::string(word));
    const std::string byLevel = pictureText(M, cutAt(1, .5, Colour::level));
    int finest = 0, count = 0;
    for (int level : M.level) finest = std::max(finest, level);
    for (int level : M.level) count += level == finest;
    CHECK(holds(byLevel, format(">%d (%d)<", finest, count)));
    const std::string bySurface = pictureText(M, cutAt(1, .5, Colour::surface));
    CHECK(holds(bySurface, ">1 a&lt;b &amp; &quot;c&quot;<"));
    CHECK(holds(bySurface, ">boundary<"));
    for (const std::string& svg : {byQuality, byLevel, bySurface}) {
      CHECK(isWellFormed(svg));
      CHECK(svg.size() < 300000);
    }
    const Mesh box = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2});
    CHECK(!holds(pictureText(box, cutAt(1, .5)), "inserted surface"));
  }

  TEST_CASE("the cut of the surface is one bold line from rim to rim") {
    const Mesh& M = insertedMesh();
    const Drawing D = drawingOf(M, cutAt(1, .5));
    std::map<int, int> ends;
    double length = 0;
    for (const BoldEdge& e : D.bold) {
      ++ends[e.a];
      ++ends[e.b];
      CHECK(e.label == 1);
      length += std::hypot(M.x[e.a].x - M.x[e.b].x, M.x[e.a].z - M.x[e.b].z);
    }
    int single = 0;
    for (const auto& [n, count] : ends) single += count == 1;
    CHECK(single == 2);
    CHECK(length > .7);
    CHECK(length < .9);
    // --colour surface: the sheet before the cut, whole, bounded by its rim
    const Drawing whole = drawingOf(M, cutAt(1, .5, Colour::surface));
    const int sheet = static_cast<int>(std::count_if(whole.facets.begin(), whole.facets.end(),
                                                     [](const Facet& f) { return f.label == 1; }));
    CHECK(sheet > static_cast<int>(surfaceFaces(M, 1).size()) / 3);
  }

  TEST_CASE("inverted elements have their own colour") {
    Mesh M = boxMesh({0, 0, 0}, {2, 2, 2}, {2, 2, 2});
    for (std::size_t n = 0; n < M.x.size(); ++n)
      if (M.x[n] == Vec3{1, 1, 1}) M.x[n] = {1.1, 3.5, 1.2};
    const std::string svg = pictureText(M, cutAt(1, .5));
    const int count = qualityStatistics(M).inverted;
    CHECK(count > 0);
    CHECK(holds(svg, format("inverted %d<", count)));
    const int inverted = qualityClasses;
    const Drawing D = drawingOf(M, cutAt(1, .5));
    const std::vector<double> q = qualities(M);
    int pink = 0;
    for (const Facet& f : D.facets) {
      CHECK((f.colour == inverted) == (q[f.tet] <= 0));
      pink += f.colour == inverted;
    }
    CHECK(pink > 0);
  }

  TEST_CASE("many faces: no edges, then squares; never above 300 kB, and the caption says it") {
    const Mesh M = boxMesh({0, 0, 0}, {7, 1, 7}, {75, 1, 75});
    const std::string plain = pictureText(M, cutAt(1, .01));
    CHECK(holds(plain, "too many for their edges"));
    CHECK(plain.size() < 300000);
    CHECK(isWellFormed(plain));
    Mesh fine = boxMesh({0, 0, 0}, {7, 1, 7}, {100, 1, 100});
    unsigned random = 1;  // no two neighbours alike: the worst for the size
    for (Vec3& x : fine.x)
      if (x.x > 0 && x.x < 7 && x.z > 0 && x.z < 7) {
        random = random * 1664525u + 1013904223u;
        x.x += .02 * (double(random >> 8) / 0x1p24 - .5) * 7;
      }
    const std::string squares = pictureText(fine, cutAt(1, .01));
    CHECK(holds(squares, "squares of"));
    CHECK(squares.size() < 300000);
    CHECK(isWellFormed(squares));
    CHECK(squares == pictureText(fine, cutAt(1, .01)));
  }

  TEST_CASE("a mesh without computational space is drawn against regular tetrahedra") {
    Mesh M;
    M.x = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}, {1, 1, 1}};
    M.tets = {{0, 1, 2, 3}, {1, 2, 3, 4}};
    const std::string svg = pictureText(M, cutAt(1, .1));
    CHECK(holds(svg, "regular tetrahedra"));
    CHECK(isWellFormed(svg));
    CHECK_THROWS_WITH(pictureText(M, cutAt(1, .1, Colour::level)),
                      doctest::Contains("the mesh has no levels of bisection"));
    CHECK_THROWS_WITH(pictureText(M, cutAt(1, .1, Colour::surface)),
                      doctest::Contains("no surface is inserted"));
    CHECK_THROWS_WITH(pictureText(M, cutAt(1, .9)),
                      doctest::Contains("no tetrahedron has its centre behind y = 0.9"));
  }

  TEST_CASE("picture and stats --histogram: wrong usage 2, errors 1, and nothing written") {
    PictureFolder folder;
    const std::string box = folder / "box.vtk", out = folder / "p.svg";
    REQUIRE(statusOf({"box", "-o", box, "--cells", "2", "2", "2"}) == 0);
    struct Case {
      std::vector<std::string> words;
      int status;
      const char* message;
    };
    const std::vector<Case> cases{
        {{"picture", box}, 2, "the output is missing: -o OUT.svg"},
        {{"picture", box, "-o", folder / "p.png"}, 2, "does not end in .svg"},
        {{"picture", box, "-o", out, "--cut", "w=3"}, 2, "is no plane for --cut; it is written"},
        {{"picture", box, "-o", out, "--cut", "y"}, 2, "is no plane"},
        {{"picture", box, "-o", out, "--cut", "y="}, 2, "is no plane"},
        {{"picture", box, "-o", out, "--cut", "y=.5x"}, 2, "is no plane"},
        {{"picture", box, "-o", out, "--cut", "y=nan"}, 2, "is no plane"},
        {{"picture", box, "-o", out, "--colour", "red"}, 2, "is no --colour; it is quality"},
        {{"picture", box, "-o", out, "--cut", "y=5"},
         1,
         "the cut y = 5 is not inside the mesh, which reaches from 0 to 1"},
        {{"picture", box, "-o", out, "--cut", "z=0"}, 1, "is not inside the mesh"},
        {{"picture", box, "-o", out, "--colour", "surface"}, 1, "no surface is inserted"},
        {{"picture", folder / "none.vtk", "-o", out}, 1, "cannot be read"},
        {{"picture", box, "-o", folder / "no/p.svg"}, 1, "its folder does not exist"},
        {{"stats", box, "--histogram", folder / "h.txt"}, 2, "does not end in .svg"},
        {{"stats", box, "--histogram", folder / "no/h.svg"}, 1, "its folder does not exist"}};
    for (const Case& c : cases) {
      std::string err;
      CHECK(statusOf(c.words, &err) == c.status);
      CHECK_MESSAGE(holds(err, c.message), err);
    }
    CHECK(std::distance(fs::directory_iterator(folder.path), fs::directory_iterator()) == 1);
    std::string err;
    CHECK(statusOf({"picture", box, "-o", out}, &err) == 0);
    CHECK(holds(err, "behind y = 0.5"));
    CHECK(readFile(out) == pictureText(readMesh(box), {{1, .5}, Colour::quality, "box.vtk", {}}));
  }

  TEST_CASE("insert --pictures: four stages of the way taken, with one cut and one scale") {
    PictureFolder folder;
    const std::string box = folder / "box.vtk", out = folder / "out.vtk", obj = folder / "s.obj";
    REQUIRE(statusOf({"box", "-o", box, "--cells", "2", "2", "2"}) == 0);
    std::ofstream file(obj);
    const TriangleSurface S = samples::sine2(.2);  // more than one way is tried
    for (Vec3 p : S.points) file << "v " << p.x << " " << p.y << " " << p.z << "\n";
    for (const auto& t : S.triangles)
      file << "f " << t[0] + 1 << " " << t[1] + 1 << " " << t[2] + 1 << "\n";
    file.close();
    std::string err;
    REQUIRE(statusOf({"insert", box, obj, "-o", out, "--lc", ".14", "--pictures", folder / "p",
                      "--stages", folder / ""},  // a folder: names without a dash
                     &err) == 0);
    PictureOptions o;
    o.cut = {1, .5};
    for (const char* stage : {"refined", "projected", "smoothed"}) {
      CAPTURE(stage);
      o.title = stage;
      const std::string svg = readFile(folder / (std::string("p_") + stage + ".svg"));
      CHECK(svg == pictureText(readMesh(folder / (std::string(stage) + ".vtk")), o));
      CHECK(holds(svg, "Behind y = 0.5: "));
    }
    const std::string original = readFile(folder / "p_original.svg");
    CHECK(holds(original, "24 of 48 tetrahedra"));
    CHECK(holds(original, "Bold: where the surface will come"));
    CHECK(statusOf({"insert", box, obj, "-o", out, "--lc", ".14", "--pictures", folder / "no/p"},
                   &err) == 1);
    CHECK(holds(err, "no/p_original.svg"));
  }

  TEST_CASE("Figure 9: a bar for each class, as high as its number") {
    QualityStatistics q;
    q.tetrahedra = 110;
    q.inverted = 4;
    q.histogram[0] = 10;
    q.histogram[19] = 100;
    q.max = 1;
    q.mean = .875;
    const std::string svg = histogramText(q, "m & n", "regular tetrahedra");
    CHECK(isWellFormed(svg));
    for (const char* part : {">m &amp; n<", ">100<", ">10<", "110 tetrahedra, inverted 4",
                             "mean 0.875", "ideal: regular"})
      CHECK_MESSAGE(holds(svg, part), std::string(part));
    CHECK(countOf(svg, "stroke=\"#223\"") == 3);  // two classes, and the inverted in the first
    CHECK(countOf(svg, "height=\"280.0\" fill=\"" + hex(qualityColour(19))) == 1);
    CHECK(countOf(svg, "height=\"28.0\" fill=\"" + hex(qualityColour(0))) == 1);
    CHECK(countOf(svg, "height=\"11.2\" fill=\"" + hex(invertedFill)) == 1);
    CHECK(roundStep(1) == 1);
    CHECK(roundStep(11) == 5);
    CHECK(roundStep(47250) == 10000);
    CHECK(roundStep(2000000000) > 0);
    PictureFolder folder;
    std::string out;
    REQUIRE(statusOf({"box", "-o", folder / "b.vtk"}) == 0);
    CHECK(statusOf({"stats", folder / "b.vtk", "--histogram", folder / "h.svg"}, nullptr, &out) ==
          0);
    CHECK(holds(out, "computational"));
    CHECK(holds(readFile(folder / "h.svg"), "6 tetrahedra, inverted 0"));
  }
}

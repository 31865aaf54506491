// SPDX-License-Identifier: MIT
//
// The command line over the library: everything that touches a file, the terminal or argv.
//   Files            reading whole files, writing beside the target and renaming
//   Text             numbers, words and lines: what all readers and writers stand on
//   Surfaces         OBJ, OFF, STL, PLY, GOCAD TSurf
//   ESRI ASCII grids terrain in
//   Polycubes        meccanos in
//   VTK legacy       meshes out and in, with all that a later insertion needs
//   Gmsh, MEDIT      meshes out and in, with labels and names
//   Pictures         the mesh behind a cut, and the histogram of its quality, as SVG
//   Commands         box, terrain, solid, insert, optimize, stats, picture, convert
//   Arguments        options, help, exit status: 0 done and valid, 1 an error, 2 wrong usage
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <charconv>
#include <climits>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <iostream>
#include <limits>
#include <map>
#include <memory>
#include <new>
#include <set>
#include <string_view>
#include <unordered_map>

#include "meccano.hpp"

namespace meccano::app {

namespace fs = std::filesystem;

// ==== Files =====================================================================================

using File = std::unique_ptr<std::FILE, int (*)(std::FILE*)>;

[[noreturn]] void fail(const std::string& sentence) { throw InputError(sentence); }

std::string systemError() { return std::strerror(errno); }

/// The bytes of a file. Errors: InputError where there is no such file, or it cannot be read.
std::string readFile(const std::string& path) {
  std::error_code none;
  if (fs::is_directory(path, none)) fail(path + ": this is a folder; name a file in it");
  File file(std::fopen(path.c_str(), "rb"), std::fclose);
  if (!file) fail(path + ": cannot be read (" + systemError() + "); check its name and its rights");
  std::string text;
  const std::uintmax_t size = fs::file_size(path, none);
  if (!none) text.reserve(size);  // not of a pipe
  std::vector<char> block(1 << 16);
  while (const std::size_t n = std::fread(block.data(), 1, block.size(), file.get()))
    text.append(block.data(), n);
  if (std::ferror(file.get())) fail(path + ": reading broke off (" + systemError() + ")");
  return text;
}

/// Devices and pipes (/dev/full, /dev/stdout) are written to as they are, never replaced.
bool isDevice(const fs::path& path) {
  std::error_code none;
  const fs::file_status s = fs::status(path, none);
  return fs::exists(s) && !fs::is_regular_file(s) && !fs::is_directory(s);
}

[[noreturn]] void failWriting(const std::string& path, const std::string& why) {
  fail(path + ": cannot be written (" + why + "); nothing was written, choose another output");
}

/// While it lives an interrupt (Ctrl-C, kill) waits, so that no file is left half-written.
class HoldInterrupts {
 public:
  HoldInterrupts() {
    sigset_t held;
    sigemptyset(&held);
    for (int signal : {SIGINT, SIGTERM, SIGHUP}) sigaddset(&held, signal);
    pthread_sigmask(SIG_BLOCK, &held, &before_);
  }
  HoldInterrupts(const HoldInterrupts&) = delete;
  HoldInterrupts& operator=(const HoldInterrupts&) = delete;
  ~HoldInterrupts() { pthread_sigmask(SIG_SETMASK, &before_, nullptr); }

 private:
  sigset_t before_;
};

/// A file beside its target with a name of its own. It disappears again unless it is put in place.
class Temporary {
 public:
  explicit Temporary(const std::string& target) : asked_(target), target_(target) {
    std::error_code none;
    if (fs::is_directory(target_, none)) failWriting(asked_, "it is a folder");
    if (fs::is_symlink(target_, none)) target_ = fs::weakly_canonical(target_, none);
    if (fs::exists(target_, none) && ::access(target_.c_str(), W_OK) != 0)
      failWriting(asked_, systemError());
    for (int i = 0; !file_ && i < 1000; ++i) {
      const std::string own = std::to_string(::getpid()) + "-" + std::to_string(i);
      name_ = target_.string() + "." + own + ".tmp";
      file_.reset(std::fopen(name_.c_str(), "wbx"));
      if (!file_ && errno != EEXIST) break;
    }
    if (!file_) {
      name_.clear();
      failWriting(asked_, errno == ENOENT ? "its folder does not exist" : systemError());
    }
  }
  Temporary(const Temporary&) = delete;
  Temporary& operator=(const Temporary&) = delete;
  ~Temporary() {
    file_.reset();
    if (!name_.empty()) std::remove(name_.c_str());
  }
  void write(const std::string& text) {
    const bool whole = std::fwrite(text.data(), 1, text.size(), file_.get()) == text.size() &&
                       std::fflush(file_.get()) == 0;
    if (!whole) failWriting(asked_, systemError());
    if (std::fclose(file_.release()) != 0) failWriting(asked_, systemError());
  }
  /// Renames it to the target, which keeps its rights if it was there.
  void putInPlace() {
    std::error_code error;
    const fs::file_status old = fs::status(target_, error);
    if (fs::exists(old)) fs::permissions(name_, old.permissions(), error);
    fs::rename(name_, target_, error);
    if (error) failWriting(asked_, error.message());
    name_.clear();
  }

 private:
  std::string asked_;
  fs::path target_;
  std::string name_;
  File file_{nullptr, std::fclose};
};

void writeDevice(const std::string& path, const std::string& text) {
  File file(std::fopen(path.c_str(), "wb"), std::fclose);
  if (!file) failWriting(path, systemError());
  const bool whole = std::fwrite(text.data(), 1, text.size(), file.get()) == text.size() &&
                     std::fflush(file.get()) == 0;
  if (!whole || std::fclose(file.release()) != 0) failWriting(path, systemError());
}

/// Tells before a long computation whether its result can be written; leaves nothing behind.
void checkWritable(const std::string& path) {
  if (isDevice(path)) return;
  const HoldInterrupts hold;
  const Temporary probe(path);
}

struct Output {
  std::string path, text;
};

/// Writes all or none: each file beside its target first, renamed when every one is complete.
void writeFiles(const std::vector<Output>& outputs) {
  std::unique_ptr<HoldInterrupts> hold;  // not for a pipe, which may never be read
  if (std::none_of(outputs.begin(), outputs.end(), [](auto& o) { return isDevice(o.path); }))
    hold = std::make_unique<HoldInterrupts>();
  std::vector<std::unique_ptr<Temporary>> files;
  for (const Output& o : outputs) {
    if (isDevice(o.path)) continue;
    files.push_back(std::make_unique<Temporary>(o.path));
    files.back()->write(o.text);
  }
  for (const Output& o : outputs)
    if (isDevice(o.path)) writeDevice(o.path, o.text);
  for (const auto& file : files) file->putInPlace();
}

// ==== Text ======================================================================================

/// A growing text; doubles in the shortest form that reads back as the same double.
class Text {
 public:
  explicit Text(std::size_t expected = 0) { text_.reserve(expected); }
  Text& operator<<(std::string_view s) { return text_.append(s), *this; }
  Text& operator<<(int value) { return put(value); }
  Text& operator<<(double value) { return put(value); }
  std::string take() { return std::move(text_); }

 private:
  template <class Number>
  Text& put(Number value) {
    char digits[32];
    text_.append(digits, std::to_chars(digits, digits + sizeof digits, value).ptr);
    return *this;
  }
  std::string text_;
};

/// printf into a string, for tables and messages.
template <class... Values>
std::string format(const char* pattern, Values... values) {
  char text[512];
  const int n = std::snprintf(text, sizeof text, pattern, values...);
  return std::string(text, std::clamp(n, 0, static_cast<int>(sizeof text) - 1));
}

std::string upper(std::string_view word) {
  std::string s(word);
  for (char& c : s)
    if (c >= 'a' && c <= 'z') c = static_cast<char>(c - 'a' + 'A');
  return s;
}

bool isSpace(char c) { return c == ' ' || c == '\t' || c == '\r' || c == '\n'; }

/// The whole word as a number; false where it is none. A leading + is allowed, as in printf's %+g.
bool parse(std::string_view word, double& value) {
  if (!word.empty() && word[0] == '+') word.remove_prefix(1);
  const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), value);
  if (end != word.data() + word.size() || word.empty()) return false;
  if (error == std::errc()) return true;
  if (error != std::errc::result_out_of_range) return false;
  value = std::strtod(std::string(word).c_str(), nullptr);  // 0 or ∞: beyond the range of double
  return true;
}

bool parse(std::string_view word, int& value) {
  const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), value);
  return error == std::errc() && end == word.data() + word.size();
}

/// Walks over a text word by word, and knows the line for messages.
class Scanner {
 public:
  /// Where a comment character is given, it and the rest of its line count as blank.
  Scanner(const std::string& name, const std::string& text, char comment = '\0')
      : name_(name), text_(text), comment_(comment) {}

  bool atEnd() {
    while (at_ < text_.size() && (isSpace(text_[at_]) || (comment_ && text_[at_] == comment_)))
      at_ = text_[at_] == comment_ ? std::min(text_.find('\n', at_), text_.size()) : at_ + 1;
    return at_ == text_.size();
  }
  std::string_view word(const char* what) {
    const bool end = atEnd();
    start_ = at_;
    if (end) failHere(std::string("the file ends where ") + what + " should be; it is truncated");
    while (at_ < text_.size() && !isSpace(text_[at_])) ++at_;
    return std::string_view(text_).substr(start_, at_ - start_);
  }
  /// The next word, which stays.
  std::string_view peek() {
    if (atEnd()) return {};
    std::size_t end = at_;
    while (end < text_.size() && !isSpace(text_[end])) ++end;
    return std::string_view(text_).substr(at_, end - at_);
  }
  bool consumed() const { return at_ == text_.size(); }
  void skip(std::size_t bytes) { at_ += bytes; }
  std::size_t position() const { return at_; }
  /// The rest of the line, without its end.
  std::string_view line() {
    start_ = at_;
    at_ = std::min(text_.find('\n', at_), text_.size());
    std::string_view rest = std::string_view(text_).substr(start_, at_ - start_);
    if (at_ < text_.size()) ++at_;
    if (!rest.empty() && rest.back() == '\r') rest.remove_suffix(1);
    return rest;
  }
  template <class Number>
  Number number(const char* what) {
    const std::string_view w = word(what);
    Number value{};
    if (!parse(w, value))
      failHere("'" + std::string(w.substr(0, 40)) + "' is no number where " + what + " should be");
    return value;
  }
  /// A number of things of which each takes a byte or more: nothing is reserved for a lie.
  int count(const char* what) {
    const int n = number<int>(what);
    if (n < 0) failHere(std::string("the number of ") + what + " is negative");
    checkRest(n, what);
    return n;
  }
  void checkRest(std::size_t n, const std::string& what) const {
    if (n > text_.size() - at_)
      failHere("the " + what + " (" + std::to_string(n) +
               ") are more than the rest of the file holds; it is truncated");
  }
  [[noreturn]] void failHere(const std::string& what) const {
    const auto lines = std::count(text_.begin(), text_.begin() + start_, '\n');
    fail(name_ + ":" + std::to_string(lines + 1) + ": " + what);
  }
  [[noreturn]] void failAsWhole(const std::string& what) const { fail(name_ + ": " + what); }

 private:
  const std::string& name_;
  const std::string& text_;
  char comment_;
  std::size_t at_ = 0, start_ = 0;
};

// ==== Lines of words ============================================================================

std::string lower(std::string_view word) {
  std::string s(word);
  for (char& c : s)
    if (c >= 'A' && c <= 'Z') c = static_cast<char>(c - 'A' + 'a');
  return s;
}

bool hasByteOrderMark(const std::string& text) { return text.compare(0, 3, "\xEF\xBB\xBF") == 0; }

/// Appends the words of a line, up to a comment (#).
void splitWords(std::string_view line, std::vector<std::string_view>& words) {
  for (std::size_t i = 0; i < line.size();) {
    if (isSpace(line[i])) {
      ++i;
      continue;
    }
    const std::size_t start = i;
    while (i < line.size() && !isSpace(line[i])) ++i;
    if (line[start] == '#') return;
    words.push_back(line.substr(start, i - start));
  }
}

/// A text line by line, each as its words: what all ASCII readers of surfaces stand on. Blank lines
/// and comments (#) are passed over, a backslash at the end joins the next line.
class Lines {
 public:
  Scanner in;
  std::vector<std::string_view> words;  // of the line; not empty after next()

  Lines(const std::string& name, const std::string& text) : in(name, text) {
    if (hasByteOrderMark(text)) in.skip(3);
  }
  bool next() {
    words.clear();
    while (words.empty() && !in.consumed()) {
      line_ = in.line();
      splitWords(line_, words);
      while (!words.empty() && words.back() == "\\" && !in.consumed()) {
        words.pop_back();
        splitWords(in.line(), words);
      }
    }
    return !words.empty();
  }
  /// What stands behind the first word, with its inner blanks.
  std::string rest() const {
    const std::size_t from = words[0].data() + words[0].size() - line_.data();
    std::string_view r = line_.substr(from);
    while (!r.empty() && isSpace(r.front())) r.remove_prefix(1);
    while (!r.empty() && isSpace(r.back())) r.remove_suffix(1);
    return std::string(r);
  }
  int integer(std::size_t i, const char* what) const {
    int value = 0;
    if (i >= words.size()) in.failHere(std::string(what) + " is missing; complete the line");
    if (!parse(words[i], value)) noNumber(i, what);
    return value;
  }
  /// Three coordinates from word i on.
  Vec3 point(std::size_t i) const {
    if (words.size() < i + 3)
      in.failHere("a vertex needs three coordinates, here are " +
                  std::to_string(words.size() - std::min(words.size(), i)) +
                  "; complete the line or remove it with its faces");
    Vec3 x;
    double* const to[3] = {&x.x, &x.y, &x.z};
    for (std::size_t k = 0; k < 3; ++k)
      if (!parse(words[i + k], *to[k])) noNumber(i + k, "the coordinate");
    if (!isFinite(x)) in.failHere("a coordinate is not finite; correct it");
    return x;
  }

 private:
  [[noreturn]] void noNumber(std::size_t i, const char* what) const {
    in.failHere("'" + std::string(words[i].substr(0, 40)) + "' is no number; correct " + what);
  }
  std::string_view line_;
};

// ==== Surfaces: OBJ, OFF, STL, PLY, GOCAD =======================================================

std::string stemOf(const std::string& path) { return fs::path(path).stem().string(); }

/// A polygon as a fan of triangles around its first corner.
void addPolygon(TriangleSurface& S, const std::vector<int>& corners) {
  for (std::size_t i = 2; i < corners.size(); ++i)
    S.triangles.push_back({corners[0], corners[i - 1], corners[i]});
}

[[noreturn]] void failTooFewCorners(const Scanner& at, std::size_t corners) {
  at.failHere("a face needs three corners, here are " + std::to_string(corners) +
              "; complete the line or remove it");
}

/// The vertex of a face corner a, a/b, a//c or a/b/c; negative numbers count from the last vertex.
int objIndex(std::string_view corner, int vertices, const Scanner& at) {
  int number = 0;
  bool good = parse(corner.substr(0, corner.find('/')), number);
  for (char c : corner.substr(std::min(corner.find('/'), corner.size())))
    good &= c == '/' || c == '-' || (c >= '0' && c <= '9');
  if (!good)
    at.failHere("'" + std::string(corner.substr(0, 40)) +
                "' is no face corner; it is written 7, 7/1, 7//1 or 7/1/1");
  const int index = number > 0 ? number - 1 : vertices + number;
  if (number == 0 || index < 0 || index >= vertices)
    at.failHere("the face names vertex " + std::to_string(number) + ", above are " +
                std::to_string(vertices) + "; correct the index (they start at 1)");
  return index;
}

/// The `v` and `f` lines of an OBJ file; one `o` or `g` name is the label; the rest is ignored.
TriangleSurface parseObj(const std::string& name, const std::string& text) {
  TriangleSurface S;
  Lines line(name, text);
  if (Scanner(name, text).atEnd())
    line.in.failAsWhole("the file is empty; an OBJ file with v and f lines is needed");
  std::set<std::string> labels;
  std::vector<int> corners;
  while (line.next()) {
    if (line.words[0] == "v") S.points.push_back(line.point(1));
    if (line.words[0] == "o" || line.words[0] == "g") labels.insert(line.rest());
    if (line.words[0] != "f") continue;
    if (line.words.size() < 4) failTooFewCorners(line.in, line.words.size() - 1);
    corners.clear();
    for (std::size_t i = 1; i < line.words.size(); ++i)
      corners.push_back(objIndex(line.words[i], static_cast<int>(S.points.size()), line.in));
    addPolygon(S, corners);
  }
  if (S.triangles.empty())
    line.in.failAsWhole("no triangle in it (" + std::to_string(S.points.size()) +
                        " vertices, no f line); is it a Wavefront OBJ file?");
  S.name = labels.size() == 1 && !labels.begin()->empty() ? *labels.begin() : stemOf(name);
  return S;
}

/// OFF with its variants COFF, NOFF, STOFF: what follows the coordinates and corners is ignored.
TriangleSurface parseOff(const std::string& name, const std::string& text) {
  TriangleSurface S;
  S.name = stemOf(name);
  Lines line(name, text);
  auto demand = [&](const char* what) {
    if (!line.next())
      line.in.failAsWhole(std::string("the file ends where ") + what +
                          " should be; it is truncated");
  };
  demand("OFF");
  if (line.words.size() > 1 && lower(line.words[1]) == "binary")
    line.in.failHere("this OFF file is binary; save it as ASCII");
  const std::size_t first = line.words.size() > 1 ? 1 : 0;  // the counts may be in the first line
  if (first == 0) demand("the numbers of vertices and faces");
  const int vertices = line.integer(first, "the number of vertices");
  const int faces = line.integer(first + 1, "the number of faces");
  if (vertices < 0 || faces < 1)
    line.in.failHere("no triangle in it (" + std::to_string(vertices) + " vertices, " +
                     std::to_string(faces) + " faces); give a surface with faces");
  for (int i = 0; i < vertices; ++i) {
    demand("a vertex");
    S.points.push_back(line.point(0));
  }
  std::vector<int> corners;
  for (int i = 0; i < faces; ++i) {
    demand("a face");
    const int count = line.integer(0, "the number of corners");
    if (count < 3) failTooFewCorners(line.in, std::max(count, 0));
    corners.clear();
    for (int k = 1; k <= count; ++k) {
      corners.push_back(line.integer(k, "a corner of the face"));
      if (corners.back() < 0 || corners.back() >= vertices)
        line.in.failHere("the face names vertex " + std::to_string(corners.back()) +
                         ", the file has " + std::to_string(vertices) +
                         "; correct the index (they start at 0)");
    }
    addPolygon(S, corners);
  }
  return S;
}

/// Each `solid` of an ASCII STL file is a surface; its name counts only where there are several
/// (that of a single one is mostly the program that wrote it).
std::vector<TriangleSurface> parseStlAscii(const std::string& name, const std::string& text) {
  std::vector<TriangleSurface> all;
  Lines line(name, text);
  bool open = false;  // a solid
  std::vector<int> corners;
  while (line.next()) {
    const std::string key = lower(line.words[0]);
    if (key != "solid" && !open)
      line.in.failHere("'" + key.substr(0, 40) +
                       "' is outside a solid; put it between solid and endsolid");
    if (key == "solid") {
      if (open) line.in.failHere("a solid begins before the last one ended; the file is damaged");
      open = true;
      all.push_back({{}, {}, line.rest()});
    } else if (key == "facet") {
      corners.clear();
    } else if (key == "vertex") {
      corners.push_back(static_cast<int>(all.back().points.size()));
      all.back().points.push_back(line.point(1));
    } else if (key == "endfacet") {
      if (corners.size() < 3) failTooFewCorners(line.in, corners.size());
      addPolygon(all.back(), corners);
    } else if (key == "endsolid") {
      open = false;
    } else if (key != "outer" && key != "endloop") {
      line.in.failHere("'" + key.substr(0, 40) +
                       "' is no keyword of an ASCII STL file; the file is damaged");
    }
  }
  if (open) line.in.failAsWhole("the file ends without endsolid; it is truncated");
  if (all.size() == 1) all[0].name = stemOf(name);
  return all;
}

std::uint32_t littleEndian(const std::string& text, std::size_t at, int bytes) {
  std::uint32_t value = 0;
  for (int i = bytes - 1; i >= 0; --i)
    value = value << 8 | static_cast<unsigned char>(text[at + i]);
  return value;
}

float floatAt(const std::string& text, std::size_t at) {
  const std::uint32_t bits = littleEndian(text, at, 4);
  float value = 0;
  std::memcpy(&value, &bits, 4);
  return value;
}

[[noreturn]] void failAtByte(const std::string& name, std::size_t at, const std::string& what) {
  fail(name + ": byte " + std::to_string(at) + ": " + what);
}

constexpr std::size_t stlHead = 84, stlFacet = 50;  // bytes: 80 of comment and the number of facets

bool isBinaryStl(const std::string& text) {
  return text.size() >= stlHead &&
         text.size() == stlHead + stlFacet * std::size_t(littleEndian(text, 80, 4));
}

TriangleSurface parseStlBinary(const std::string& name, const std::string& text) {
  if (text.size() < stlHead)
    failAtByte(name, text.size(), "the file ends in its head of 84 bytes; it is truncated");
  const std::size_t facets = littleEndian(text, 80, 4);
  if (!isBinaryStl(text))
    failAtByte(name, 80,
               "the head promises " + std::to_string(facets) + " triangles, which are " +
                   std::to_string(stlHead + stlFacet * facets) + " bytes, and the file has " +
                   std::to_string(text.size()) + "; it is truncated or damaged");
  if (facets == 0) failAtByte(name, 80, "no triangle in it; give a surface with triangles");
  TriangleSurface S;
  S.name = stemOf(name);
  for (std::size_t t = 0; t < facets; ++t) {
    const int first = static_cast<int>(S.points.size());
    for (int k = 1; k <= 3; ++k) {  // the normal comes first
      const std::size_t at = stlHead + stlFacet * t + 12 * k;
      const Vec3 x{floatAt(text, at), floatAt(text, at + 4), floatAt(text, at + 8)};
      if (!isFinite(x)) failAtByte(name, at, "a coordinate is not finite; correct it");
      S.points.push_back(x);
    }
    S.triangles.push_back({first, first + 1, first + 2});
  }
  return S;
}

/// The values of a PLY file behind its head, one after the other, in either coding.
class PlyValues {
 public:
  enum Type { int8, uint8, int16, uint16, int32, uint32, float32, float64 };

  PlyValues(const std::string& name, const std::string& text, Scanner& in, bool binary)
      : name_(name), text_(text), in_(in), binary_(binary), at_(in.position()) {}
  double next(Type type, const char* what) {
    static constexpr int sizes[] = {1, 1, 2, 2, 4, 4, 4, 8};
    if (!binary_) return in_.number<double>(what);
    last_ = at_;
    at_ += sizes[type];
    if (at_ > text_.size())
      failHere(std::string("the file ends where ") + what + " should be; it is truncated");
    if (type == float32) return floatAt(text_, last_);
    if (type == float64) {
      const std::uint64_t high = littleEndian(text_, last_ + 4, 4);
      const std::uint64_t bits = high << 32 | littleEndian(text_, last_, 4);
      double value = 0;
      std::memcpy(&value, &bits, 8);
      return value;
    }
    const double value = littleEndian(text_, last_, sizes[type]);
    const bool isSigned = type == int8 || type == int16 || type == int32;
    const double range = std::ldexp(1.0, 8 * sizes[type]);
    return isSigned && value >= range / 2 ? value - range : value;
  }
  /// An integer in [0, below).
  int index(Type type, double below, const char* what) {
    const double value = next(type, what);
    if (!(value >= 0 && value < below && value == std::floor(value)))
      failHere(format("%.9g", value) + " is " + what + ", it must be an integer from 0 to " +
               format("%.9g", below - 1));
    return static_cast<int>(value);
  }
  [[noreturn]] void failHere(const std::string& what) const {
    if (binary_) failAtByte(name_, last_, what);
    in_.failHere(what);
  }

 private:
  const std::string &name_, &text_;
  Scanner& in_;
  bool binary_;
  std::size_t at_, last_ = 0;
};

struct PlyProperty {
  std::string name;
  PlyValues::Type type;
  bool list;
  PlyValues::Type countType;
};

struct PlyElement {
  std::string name;
  int count;
  std::vector<PlyProperty> properties;
};

PlyValues::Type plyType(std::string_view word, const Scanner& at) {
  static const std::map<std::string_view, PlyValues::Type> types{
      {"char", PlyValues::int8},      {"int8", PlyValues::int8},
      {"uchar", PlyValues::uint8},    {"uint8", PlyValues::uint8},
      {"short", PlyValues::int16},    {"int16", PlyValues::int16},
      {"ushort", PlyValues::uint16},  {"uint16", PlyValues::uint16},
      {"int", PlyValues::int32},      {"int32", PlyValues::int32},
      {"uint", PlyValues::uint32},    {"uint32", PlyValues::uint32},
      {"float", PlyValues::float32},  {"float32", PlyValues::float32},
      {"double", PlyValues::float64}, {"float64", PlyValues::float64}};
  const auto found = types.find(word);
  if (found == types.end())
    at.failHere("'" + std::string(word.substr(0, 40)) +
                "' is no type of a PLY property; correct the head");
  return found->second;
}

/// The elements of the head; the scanner stands behind it then.
std::vector<PlyElement> readPlyHead(Lines& line, bool& binary) {
  std::vector<PlyElement> elements;
  std::string coding;
  while (line.next() && line.words[0] != "end_header") {
    const std::vector<std::string_view>& w = line.words;
    if (w[0] == "format" && w.size() > 1) {
      coding = w[1];
      if (coding == "binary_big_endian")
        line.in.failHere("this PLY file is big-endian; save it as ASCII or binary little-endian");
      if (coding != "ascii" && coding != "binary_little_endian")
        line.in.failHere("'" + coding.substr(0, 40) +
                         "' is no format of a PLY file; save it as ASCII or binary little-endian");
    } else if (w[0] == "element" && w.size() > 2) {
      elements.push_back({std::string(w[1]), line.integer(2, "the number of elements"), {}});
      if (elements.back().count < 0)
        line.in.failHere("the number of elements is negative; correct it");
    } else if (w[0] == "property" && !elements.empty() && w.size() > 2 && w[1] != "list") {
      const PlyValues::Type type = plyType(w[1], line.in);
      elements.back().properties.push_back({std::string(w[2]), type, false, type});
    } else if (w[0] == "property" && !elements.empty() && w.size() > 4) {
      elements.back().properties.push_back(
          {std::string(w[4]), plyType(w[3], line.in), true, plyType(w[2], line.in)});
    } else if (w[0] != "ply" && w[0] != "comment" && w[0] != "obj_info") {
      line.in.failHere("'" + std::string(w[0].substr(0, 40)) +
                       "' cannot be read in the head of a PLY file; it is damaged");
    }
  }
  if (line.words.empty()) line.in.failAsWhole("the head has no end_header; the file is truncated");
  if (coding.empty()) line.in.failAsWhole("the head has no format; the file is damaged");
  binary = coding != "ascii";
  return elements;
}

/// A value or a list; the list is returned only where it is asked for.
void readPlyProperty(PlyValues& values, const PlyProperty& p, double* value, double vertices,
                     std::vector<int>* corners) {
  if (!p.list) {
    const double v = values.next(p.type, "a value");
    if (value) *value = v;
    return;
  }
  for (int k = values.index(p.countType, INT_MAX, "the length of a list"); k > 0; --k)
    if (corners)
      corners->push_back(values.index(p.type, vertices, "the vertex of a face"));
    else
      values.next(p.type, "a value");
}

void demandCoordinates(const PlyElement& vertex, const Scanner& in) {
  for (const char* axis : {"x", "y", "z"})
    if (std::none_of(vertex.properties.begin(), vertex.properties.end(),
                     [&](const PlyProperty& p) { return p.name == axis && !p.list; }))
      in.failAsWhole(std::string("its vertices have no property ") + axis +
                     "; x, y and z are needed");
}

TriangleSurface parsePly(const std::string& name, const std::string& text) {
  Lines line(name, text);
  bool binary = false;
  const std::vector<PlyElement> elements = readPlyHead(line, binary);
  PlyValues values(name, text, line.in, binary);
  TriangleSurface S;
  S.name = stemOf(name);
  for (const PlyElement& element : elements) {
    const bool vertex = element.name == "vertex", face = element.name == "face";
    if (vertex) demandCoordinates(element, line.in);
    if (!element.properties.empty()) line.in.checkRest(element.count, element.name + " elements");
    std::vector<int> corners;
    for (int i = 0; i < element.count && !element.properties.empty(); ++i) {
      Vec3 x;
      corners.clear();
      for (const PlyProperty& p : element.properties) {
        double* const to = p.name == "x"   ? &x.x
                           : p.name == "y" ? &x.y
                           : p.name == "z" ? &x.z
                                           : nullptr;
        const bool wanted = face && (p.name == "vertex_indices" || p.name == "vertex_index");
        readPlyProperty(values, p, to, double(S.points.size()), wanted ? &corners : nullptr);
      }
      if (vertex && !isFinite(x)) values.failHere("a coordinate is not finite; correct it");
      if (vertex) S.points.push_back(x);
      if (face && corners.size() < 3)
        values.failHere("a face needs three corners, here are " + std::to_string(corners.size()) +
                        "; correct or remove it");
      if (face) addPolygon(S, corners);
    }
  }
  if (S.triangles.empty())
    line.in.failAsWhole("no triangle in it (" + std::to_string(S.points.size()) +
                        " vertices, no face element); give a surface with faces");
  return S;
}

/// One TSurf object of a GOCAD file: from its first line to END.
struct GocadObject {
  TriangleSurface S;
  std::unordered_map<int, int> point;  // of an id
  bool inHeader = false, depth = false;

  int pointOf(const Lines& line, std::size_t i) const {
    const int id = line.integer(i, "the number of a vertex");
    const auto found = point.find(id);
    if (found == point.end())
      line.in.failHere("vertex " + std::to_string(id) +
                       " is named, and no VRTX or ATOM line above defines it; correct the number");
    return found->second;
  }
  /// A vertex line defines its id by coordinates, an atom by another vertex.
  void define(const Lines& line, bool atom) {
    const int id = line.integer(1, "the number of a vertex");
    const int at = atom ? pointOf(line, 2) : static_cast<int>(S.points.size());
    if (!atom) S.points.push_back(line.point(2));
    if (!point.insert({id, at}).second)
      line.in.failHere("vertex " + std::to_string(id) + " is there twice; renumber one");
  }
  void read(const Lines& line) {
    const std::string_view key = line.words[0];
    if (key.substr(0, 6) == "HEADER") inHeader = true;
    if (key == "}") inHeader = false;
    if (inHeader && key.substr(0, 5) == "name:") {
      S.name = key.size() > 5 ? std::string(key.substr(5)) + " " : "";
      S.name += line.rest();
      while (!S.name.empty() && S.name.back() == ' ') S.name.pop_back();
    }
    if (key == "ZPOSITIVE" && line.words.size() > 1) depth = lower(line.words[1]) == "depth";
    if (key == "VRTX" || key == "PVRTX") define(line, false);
    if (key == "ATOM" || key == "PATOM") define(line, true);
    if (key != "TRGL") return;
    if (line.words.size() < 4) failTooFewCorners(line.in, line.words.size() - 1);
    S.triangles.push_back({pointOf(line, 1), pointOf(line, 2), pointOf(line, 3)});
  }
};

/// The TSurf objects of a GOCAD file, z upward; objects and lines of other kinds are passed over.
std::vector<TriangleSurface> parseGocad(const std::string& name, const std::string& text,
                                        std::vector<std::string>& warnings) {
  std::vector<TriangleSurface> all;
  Lines line(name, text);
  GocadObject object;
  bool open = false, surface = false;
  while (line.next()) {
    const std::string_view key = line.words[0];
    if (key == "GOCAD") {
      if (open) line.in.failHere("an object begins before the last one had its END; add END there");
      open = true;
      surface = line.words.size() > 1 && lower(line.words[1]) == "tsurf";
      object = GocadObject();
      object.S.name = stemOf(name);
    } else if (key == "END" && open && surface) {
      if (object.S.triangles.empty())
        line.in.failHere("surface '" + object.S.name + "' has no TRGL line; remove the object");
      if (object.depth) {
        for (Vec3& x : object.S.points) x.z = -x.z;
        warnings.push_back("surface '" + object.S.name + "': ZPOSITIVE Depth, z is negated");
      }
      all.push_back(object.S);
    } else if (open && surface) {
      object.read(line);
    }
    if (key == "END") open = false;
  }
  if (open) line.in.failAsWhole("the last object has no END; the file is truncated");
  if (all.empty()) line.in.failAsWhole("no TSurf object in it; export the surface as TSurf");
  return all;
}

// ==== Formats ===================================================================================

enum class Format { none, obj, off, stlAscii, stlBinary, ply, gocad, vtk, msh, medit };

bool isMesh(Format f) { return f == Format::vtk || f == Format::msh || f == Format::medit; }

const char* nameOf(Format f) {
  constexpr const char* names[] = {"unknown", "OBJ",   "OFF",        "STL",  "STL",
                                   "PLY",     "TSurf", "VTK legacy", "Gmsh", "MEDIT"};
  return names[static_cast<int>(f)];
}

/// What the content is. The suffix decides only where OBJ or STL show nothing of their kind.
Format formatOf(const std::string& path, const std::string& text) {
  static const std::pair<Format, const char*> firstWords[] = {
      {Format::ply, " ply "},
      {Format::gocad, " gocad "},
      {Format::medit, " meshversionformatted "},
      {Format::off, " off coff noff cnoff stoff stcnoff "},
      {Format::obj, " v vt vn f o g mtllib usemtl "}};
  if (isBinaryStl(text)) return Format::stlBinary;
  if (text.compare(0, 14, "# vtk DataFile") == 0) return Format::vtk;
  Lines line(path, text);
  const std::string first = line.next() ? lower(line.words[0]) : "";
  if (first[0] == '$') return Format::msh;
  for (const auto& [format, words] : firstWords)
    if (std::string(words).find(" " + first + " ") != std::string::npos) return format;
  const std::string suffix = lower(fs::path(path).extension().string());
  const bool binary = text.find('\0') != std::string::npos;
  if (first == "solid" && !binary) return Format::stlAscii;
  if (first == "solid" || (suffix == ".stl" && !text.empty())) return Format::stlBinary;
  return suffix == ".obj" ? Format::obj : Format::none;
}

/// The surfaces of a file's text, each welded and cleaned; what was mended is warned of.
std::vector<TriangleSurface> parseSurfaces(const std::string& path, const std::string& text,
                                           std::vector<std::string>& warnings) {
  std::vector<TriangleSurface> raw;
  std::vector<std::string> notes;
  const Format f = formatOf(path, text);
  if (f == Format::obj) raw = {parseObj(path, text)};
  if (f == Format::off) raw = {parseOff(path, text)};
  if (f == Format::stlAscii) raw = parseStlAscii(path, text);
  if (f == Format::stlBinary) raw = {parseStlBinary(path, text)};
  if (f == Format::ply) raw = {parsePly(path, text)};
  if (f == Format::gocad) raw = parseGocad(path, text, notes);
  if (isMesh(f))
    fail(path + ": this is a mesh (" + nameOf(f) + "), and a surface is needed; name a surface");
  if (f == Format::none)
    fail(
        path + (text.empty() ? ": the file is empty" : ": its content is of no known format") +
        "; surfaces are read from OBJ, OFF, STL, PLY (ASCII, little-endian) and GOCAD TSurf files");
  std::vector<TriangleSurface> all;
  for (const TriangleSurface& S : raw) {
    const std::size_t before = notes.size();
    all.push_back(weldSurface(S, notes));
    if (notes.size() > before) notes.back() += " of surface '" + S.name + "'";
    if (all.back().triangles.empty())
      fail(path + ": surface '" + S.name + "' is empty: none of its " +
           std::to_string(S.triangles.size()) + " triangles has an area; check its coordinates");
  }
  for (const std::string& note : notes) warnings.push_back(path + ": " + note);
  return all;
}

std::vector<TriangleSurface> readSurfaces(const std::string& path,
                                          std::vector<std::string>& warnings) {
  return parseSurfaces(path, readFile(path), warnings);
}

// ==== ESRI ASCII grids ===========================================================================

/// The header: keys in any case and order, until the first line that starts with a number.
struct AscHeader {
  std::map<std::string, double> value;
  double of(const char* key, const Scanner& in) const {
    const auto found = value.find(key);
    if (found == value.end())
      in.failAsWhole(std::string("the key ") + key +
                     " is missing in the header; is it an ESRI ASCII grid?");
    return found->second;
  }
};

AscHeader readAscHeader(Scanner& in) {
  static const char* const keys[] = {"ncols",     "nrows",     "xllcorner", "xllcenter",
                                     "yllcorner", "yllcenter", "cellsize",  "nodata_value"};
  AscHeader header;
  double ignored;
  while (!in.atEnd() && !parse(in.peek(), ignored)) {
    const std::string key = lower(in.word("a key of the header"));
    if (std::find(std::begin(keys), std::end(keys), key) == std::end(keys))
      in.failHere("'" + key.substr(0, 40) +
                  "' is no key of an ESRI ASCII grid (ncols, nrows, xllcorner or xllcenter, "
                  "yllcorner or yllcenter, cellsize, NODATA_value)");
    if (header.value.count(key)) in.failHere(key + " is given twice; keep one");
    header.value[key] = in.number<double>("its value");
    if (!std::isfinite(header.value[key])) in.failHere(key + " is not finite; correct it");
  }
  return header;
}

int ascCount(const AscHeader& header, const char* key, const Scanner& in) {
  constexpr int most = 100000;
  const double n = header.of(key, in);
  if (!(n >= 2 && n <= most && n == std::floor(n)))
    in.failAsWhole(std::string(key) + " = " + format("%.9g", n) + " must be an integer from 2 to " +
                   std::to_string(most));
  return static_cast<int>(n);
}

/// The lowest coordinate of the grid points, which are the centres of the cells.
double ascOrigin(const AscHeader& header, char axis, double cell, const Scanner& in) {
  const std::string corner = std::string(1, axis) + "llcorner",
                    centre = std::string(1, axis) + "llcenter";
  if (header.value.count(corner) && header.value.count(centre))
    in.failAsWhole(corner + " and " + centre + " are both given; keep one");
  if (header.value.count(centre)) return header.of(centre.c_str(), in);
  return header.of(corner.c_str(), in) + .5 * cell;
}

/// Geographic coordinates lie within +-360, and their cells are small; a grid in metres fits in
/// there only where it is as small as that.
void refuseDegrees(const Terrain& T, double relief, const Scanner& in) {
  const bool geographic = std::abs(T.origin.x) <= 360 && std::abs(T.origin.y) <= 90;
  const double width = T.cell * std::max(T.nx, T.ny);
  if (geographic && T.cell < .1 && width <= 360 && relief > width)
    in.failAsWhole(
        "cellsize " + format("%.9g", T.cell) +
        " looks like degrees, and heights in metres need metres: project the grid first "
        "(gdalwarp -t_srs EPSG:326ZZ, ZZ the UTM zone; then gdal_translate -of AAIGrid)");
}

/// One row of heights: from west to east.
void readAscRow(Scanner& in, Terrain& T, int row, double nodata) {
  std::vector<std::string_view> words;
  splitWords(in.line(), words);
  const std::string name = "row " + std::to_string(row + 1);
  if (static_cast<int>(words.size()) != T.nx)
    in.failHere(name + " has " + std::to_string(words.size()) + " heights, ncols promises " +
                std::to_string(T.nx) + "; complete the row");
  for (int i = 0; i < T.nx; ++i) {
    double z = 0;
    const std::string at = name + ", column " + std::to_string(i + 1) + ": ";
    if (!parse(words[i], z))
      in.failHere(at + "'" + std::string(words[i].substr(0, 40)) + "' is no number; correct it");
    if (z == nodata)
      in.failHere(at + "no data (" + format("%.9g", z) +
                  "); cut the grid to where it has heights, or fill the gap");
    if (!std::isfinite(z)) in.failHere(at + "the height is not finite; correct it");
    T.z[std::size_t(T.ny - 1 - row) * T.nx + i] = z;
  }
}

/// A terrain without its top. Rows go from north to south in the file, upwards in Terrain::z.
Terrain parseAsc(const std::string& name, const std::string& text) {
  Scanner in(name, text);
  if (in.atEnd()) in.failAsWhole("the file is empty; an ESRI ASCII grid is needed");
  const AscHeader header = readAscHeader(in);
  Terrain T;
  T.name = fs::path(name).stem().string();
  T.nx = ascCount(header, "ncols", in);
  T.ny = ascCount(header, "nrows", in);
  T.cell = header.of("cellsize", in);
  if (!(T.cell > 0)) in.failAsWhole("cellsize must be above 0");
  T.origin = {ascOrigin(header, 'x', T.cell, in), ascOrigin(header, 'y', T.cell, in)};
  in.checkRest(std::size_t(T.nx) * T.ny, "heights");
  T.z.resize(std::size_t(T.nx) * T.ny);
  constexpr double none = std::numeric_limits<double>::quiet_NaN();
  const double nodata = header.value.count("nodata_value") ? header.of("nodata_value", in) : none;
  for (int row = 0; row < T.ny; ++row) {
    if (in.atEnd())
      in.failAsWhole("the file ends after " + std::to_string(row) + " rows, nrows promises " +
                     std::to_string(T.ny) + "; it is truncated");
    readAscRow(in, T, row, nodata);
  }
  if (!in.atEnd())
    in.failAsWhole("more than the " + std::to_string(T.ny) + " rows that nrows promises");
  const auto [low, high] = std::minmax_element(T.z.begin(), T.z.end());
  refuseDegrees(T, *high - *low, in);
  return T;
}

Terrain readTerrain(const std::string& path) { return parseAsc(path, readFile(path)); }

// ==== Polycubes =================================================================================

/// `cube i j k` lines, and `corner i j k  x y z` where a corner of the meccano goes; # comments.
Meccano parsePolycube(const std::string& name, const std::string& text) {
  constexpr int farthest = 100000;
  Meccano D;
  Lines lines(name, text);
  const std::vector<std::string_view>& words = lines.words;
  while (lines.next()) {
    const bool corner = words[0] == "corner";
    if (!corner && words[0] != "cube")
      lines.in.failHere(
          "'" + std::string(words[0].substr(0, 40)) +
          "' is no line of a polycube; they are `cube i j k` and `corner i j k  x y z`");
    if (words.size() != (corner ? 7u : 4u))
      lines.in.failHere(
          std::string(corner ? "a corner is `corner i j k  x y z`" : "a cube is `cube i j k`") +
          ", here are " + std::to_string(words.size() - 1) + " numbers");
    std::array<int, 3> at;
    for (int i = 0; i < 3; ++i)
      if (!parse(words[i + 1], at[i]) || std::abs(at[i]) > farthest)
        lines.in.failHere("'" + std::string(words[i + 1].substr(0, 40)) +
                          "' is no integer of the lattice; correct it");
    if (!corner) {
      if (std::find(D.cubes.begin(), D.cubes.end(), at) != D.cubes.end())
        lines.in.failHere("this cube is given twice; keep one line");
      D.cubes.push_back(at);
      continue;
    }
    double x[3];
    for (int i = 0; i < 3; ++i)
      if (!parse(words[i + 4], x[i]) || !std::isfinite(x[i]))
        lines.in.failHere("'" + std::string(words[i + 4].substr(0, 40)) +
                          "' is no coordinate; correct it");
    D.corners.push_back({at, {x[0], x[1], x[2]}});
  }
  if (D.cubes.empty()) lines.in.failAsWhole("no `cube i j k` line in it; is it a polycube?");
  return D;
}

// ==== VTK legacy: the arrays ====================================================================

/// A named array of numbers: field, point or cell data.
struct Array {
  std::string name;
  int components = 1;
  bool integer = false;
  std::vector<double> values;  // [tuples * components]; integers below 2^53 are exact

  int tuples() const { return static_cast<int>(values.size()) / components; }
  void add(double value) { values.push_back(value); }
  void add(Vec2 u) { values.insert(values.end(), {u.x, u.y}); }
  void add(Vec3 x) { values.insert(values.end(), {x.x, x.y, x.z}); }
};

using Arrays = std::map<std::string, Array>;

/// Takes an array apart from front to back; what is short, long or no integer is refused.
class Unpacking {
 public:
  Unpacking(const Arrays& arrays, const char* name, int components, const Scanner& in)
      : name_(name), in_(in) {
    const auto found = arrays.find(name);
    if (found == arrays.end()) return;
    array_ = &found->second;
    if (array_->components != components)
      refuse("has " + std::to_string(array_->components) + " components, not " +
             std::to_string(components));
  }
  bool atEnd() const { return !array_ || at_ == array_->values.size(); }
  double real() {
    if (atEnd()) refuse("is too short");
    const double value = array_->values[at_++];
    if (!std::isfinite(value)) refuse("holds a number that is not finite");
    return value;
  }
  int integer(int low, int high) {
    const double value = real();
    if (!(value >= low && value <= high && value == std::floor(value)))
      refuse("holds " + format("%.9g", value) + " where an integer from " + std::to_string(low) +
             " to " + std::to_string(high) + " is due");
    return static_cast<int>(value);
  }
  Vec2 vec2() {
    const double x = real();
    return {x, real()};
  }
  Vec3 vec3() {
    const double x = real(), y = real();
    return {x, y, real()};
  }
  void finish() const {
    if (!atEnd()) refuse("is too long");
  }

 private:
  [[noreturn]] void refuse(const std::string& what) const {
    in_.failAsWhole("array '" + name_ + "' " + what + "; the file is damaged, write it anew");
  }
  std::string name_;
  const Scanner& in_;
  const Array* array_ = nullptr;
  std::size_t at_ = 0;
};

// Geometry in the FIELD block. Lists of different lengths are packed one behind the other:
//   cube             3  edge lengths of an undeformed cube
//   surface_size     5  label (k or -p), points, triangles, rim, bytes of the name
//   surface_points   3, surface_u 2, surface_triangles 3, surface_name 1 (bytes)
//   curve_size       3  points, closed, sides
//   curve_points     3, curve_s 1 (one more where closed), curve_side 1 (label), curve_u 2
//   corner_point     3, corner_places 1 (number), corner_curve 1, corner_s 1

void packSurface(const Parametrization& P, int label, std::array<Array, 5>& a) {
  for (int n : {label, static_cast<int>(P.points.size()), static_cast<int>(P.triangles.size()),
                P.rim, static_cast<int>(P.name.size())})
    a[0].add(n);
  for (Vec3 x : P.points) a[1].add(x);
  for (Vec2 u : P.u) a[2].add(u);
  for (const std::array<int, 3>& t : P.triangles)
    for (int n : t) a[3].add(n);
  for (char c : P.name) a[4].add(static_cast<unsigned char>(c));
}

void packCurve(const Curve& C, std::array<Array, 5>& a) {
  for (int n : {static_cast<int>(C.points.size()), static_cast<int>(C.closed),
                static_cast<int>(C.sides.size())})
    a[0].add(n);
  for (Vec3 x : C.points) a[1].add(x);
  for (double s : C.s) a[2].add(s);
  for (const Curve::Side& side : C.sides) {
    a[3].add(side.surface);
    for (Vec2 u : side.u) a[4].add(u);
  }
}

void packCorner(const Corner& corner, std::array<Array, 4>& a) {
  a[0].add(corner.x);
  a[1].add(static_cast<int>(corner.on.size()));
  for (const Corner::Place& place : corner.on) {
    a[2].add(place.curve);
    a[3].add(place.s);
  }
}

std::vector<Array> packGeometry(const Mesh& M) {
  Array cube{"cube", 3, false, {M.cube.x, M.cube.y, M.cube.z}};
  std::array<Array, 5> surfaces{{{"surface_size", 5, true, {}},
                                 {"surface_points", 3, false, {}},
                                 {"surface_u", 2, false, {}},
                                 {"surface_triangles", 3, true, {}},
                                 {"surface_name", 1, true, {}}}};
  for (std::size_t k = 0; k < M.surfaces.size(); ++k)
    packSurface(M.surfaces[k], static_cast<int>(k) + 1, surfaces);
  for (std::size_t p = 0; p < M.patches.size(); ++p)
    packSurface(M.patches[p], -static_cast<int>(p) - 1, surfaces);
  std::array<Array, 5> curves{{{"curve_size", 3, true, {}},
                               {"curve_points", 3, false, {}},
                               {"curve_s", 1, false, {}},
                               {"curve_side", 1, true, {}},
                               {"curve_u", 2, false, {}}}};
  for (const Curve& C : M.curves) packCurve(C, curves);
  std::array<Array, 4> corners{{{"corner_point", 3, false, {}},
                                {"corner_places", 1, true, {}},
                                {"corner_curve", 1, true, {}},
                                {"corner_s", 1, false, {}}}};
  for (const Corner& c : M.corners) packCorner(c, corners);
  std::vector<Array> all{cube};
  for (const auto* group : {&surfaces, &curves})
    for (const Array& a : *group)
      if (!a.values.empty()) all.push_back(a);
  for (const Array& a : corners)
    if (!a.values.empty()) all.push_back(a);
  return all;
}

bool inUnitSquare(Vec2 u) {
  constexpr double rounding = 1e-6;  // of the solve for u
  return std::abs(u.x - .5) <= .5 + rounding && std::abs(u.y - .5) <= .5 + rounding;
}

void unpackSurfaces(const Arrays& field, Mesh& M, const Scanner& in) {
  Unpacking size(field, "surface_size", 5, in), points(field, "surface_points", 3, in),
      u(field, "surface_u", 2, in), triangles(field, "surface_triangles", 3, in),
      name(field, "surface_name", 1, in);
  while (!size.atEnd()) {
    const int label = size.integer(-INT_MAX, INT_MAX);
    std::vector<Parametrization>& list = label > 0 ? M.surfaces : M.patches;
    if (std::abs(label) != static_cast<int>(list.size()) + 1)
      in.failAsWhole("surface labels in 'surface_size' are not 1, 2, ..., -1, -2, ...");
    list.emplace_back();
    Parametrization& P = list.back();
    const int nodes = size.integer(3, INT_MAX), count = size.integer(1, INT_MAX);
    P.rim = size.integer(0, INT_MAX);
    const int bytes = size.integer(0, INT_MAX);
    for (int i = 0; i < nodes; ++i) {
      P.points.push_back(points.vec3());
      P.u.push_back(u.vec2());
      if (!inUnitSquare(P.u.back())) in.failAsWhole("a point of 'surface_u' is not in [0,1]^2");
    }
    for (int i = 0; i < count; ++i) {
      const int a = triangles.integer(0, nodes - 1), b = triangles.integer(0, nodes - 1);
      P.triangles.push_back({a, b, triangles.integer(0, nodes - 1)});
    }
    for (int i = 0; i < bytes; ++i) P.name += static_cast<char>(name.integer(0, 255));
    buildLocator(P);
  }
  for (const Unpacking* a : {&points, &u, &triangles, &name}) a->finish();
}

void unpackCurves(const Arrays& field, Mesh& M, const Scanner& in) {
  Unpacking size(field, "curve_size", 3, in), points(field, "curve_points", 3, in),
      s(field, "curve_s", 1, in), side(field, "curve_side", 1, in), u(field, "curve_u", 2, in);
  const int surfaces = static_cast<int>(M.surfaces.size());
  const int patches = static_cast<int>(M.patches.size());
  while (!size.atEnd()) {
    Curve C;
    const int nodes = size.integer(2, INT_MAX);
    C.closed = size.integer(0, 1) == 1;
    const int sides = size.integer(0, INT_MAX);
    for (int i = 0; i < nodes; ++i) C.points.push_back(points.vec3());
    for (int i = 0; i < nodes + C.closed; ++i) C.s.push_back(s.real());
    if (C.s[0] != 0 || !std::is_sorted(C.s.begin(), C.s.end()) || !(C.s.back() > 0))
      in.failAsWhole("arc lengths in 'curve_s' do not grow from 0; the file is damaged");
    for (int i = 0; i < sides; ++i) {
      C.sides.push_back({side.integer(-patches, surfaces), {}});
      if (C.sides.back().surface == 0) in.failAsWhole("a side in 'curve_side' is 0, no surface");
      for (int j = 0; j < nodes; ++j) C.sides.back().u.push_back(u.vec2());
    }
    M.curves.push_back(C);
  }
  for (const Unpacking* a : {&points, &s, &side, &u}) a->finish();
  for (const auto* list : {&M.surfaces, &M.patches})
    for (const Parametrization& P : *list)
      if (P.rim > static_cast<int>(M.curves.size()))
        in.failAsWhole("surface '" + P.name + "' has rim " + std::to_string(P.rim) + ", the file " +
                       std::to_string(M.curves.size()) + " curves; it is damaged");
}

void unpackCorners(const Arrays& field, Mesh& M, const Scanner& in) {
  Unpacking point(field, "corner_point", 3, in), places(field, "corner_places", 1, in),
      curve(field, "corner_curve", 1, in), s(field, "corner_s", 1, in);
  while (!point.atEnd()) {
    Corner corner{point.vec3(), {}};
    for (int i = places.integer(0, INT_MAX); i > 0; --i) {
      const int c = curve.integer(1, static_cast<int>(M.curves.size()));
      corner.on.push_back({c, s.real()});
    }
    M.corners.push_back(corner);
  }
  for (const Unpacking* a : {&places, &curve, &s}) a->finish();
}

// ==== VTK legacy: writing =======================================================================

/// A labelled face as the file has it, with the worst q of the tetrahedra beside it.
struct Face {
  std::array<int, 3> nodes;
  int label;
  double q;
};

struct Cells {
  std::vector<std::array<int, 4>> tets;  // [tets], positively oriented
  std::vector<double> q;                 // [tets], eq. (7)
  std::vector<Face> faces;               // inserted surfaces 1, 2, ..., then patches 1, 2, ...
};

double sixVolumes(const std::vector<Vec3>& x, const std::array<int, 4>& z) {
  return det({x[z[1]] - x[z[0]], x[z[2]] - x[z[0]], x[z[3]] - x[z[0]]});
}

bool hasDirectedEdge(const std::array<int, 3>& t, int a, int b) {
  return (t[0] == a && t[1] == b) || (t[1] == a && t[2] == b) || (t[2] == a && t[0] == b);
}

/// Turns the triangles of S_M all one way: that of 𝓢, where their nodes know their u.
void orientSheet(const Mesh& M, std::vector<Face>& faces) {
  using EdgeOfFace = std::pair<std::pair<int, int>, int>;  // the face's number last
  std::vector<EdgeOfFace> atEdge;                          // sorted
  for (std::size_t f = 0; f < faces.size(); ++f)
    for (int i = 0; i < 3; ++i)
      atEdge.push_back({std::minmax(faces[f].nodes[i], faces[f].nodes[(i + 1) % 3]), f});
  std::sort(atEdge.begin(), atEdge.end());
  std::vector<char> seen(faces.size(), 0);
  std::vector<int> stack;
  for (std::size_t seed = 0; seed < faces.size(); ++seed) {
    if (!seen[seed]) stack.push_back(static_cast<int>(seed)), seen[seed] = 1;
    while (!stack.empty()) {
      const std::array<int, 3> t = faces[stack.back()].nodes;
      stack.pop_back();
      for (int i = 0; i < 3; ++i) {
        const int a = t[i], b = t[(i + 1) % 3];
        const std::pair<int, int> edge = std::minmax(a, b);
        auto it = std::lower_bound(atEdge.begin(), atEdge.end(), EdgeOfFace{edge, 0});
        for (; it != atEdge.end() && it->first == edge; ++it) {
          if (seen[it->second]++) continue;
          std::array<int, 3>& other = faces[it->second].nodes;
          if (hasDirectedEdge(other, a, b)) std::swap(other[1], other[2]);
          stack.push_back(it->second);
        }
      }
    }
  }
  if (M.dimension.empty()) return;
  double area = 0;  // in 𝓤, where 𝓢 turns counter-clockwise
  for (const Face& f : faces) {
    bool known = true;
    for (int n : f.nodes) known &= M.dimension[n] == 2 && M.entity[n] == f.label;
    const Vec2 u = M.parameter[f.nodes[0]];
    if (known) area += cross(M.parameter[f.nodes[1]] - u, M.parameter[f.nodes[2]] - u);
  }
  if (area < 0)
    for (Face& f : faces) std::swap(f.nodes[1], f.nodes[2]);
}

/// A face of an inserted surface is seen from both of its tetrahedra: keeps the first of each two.
void joinFaces(std::vector<Face>& faces) {
  std::vector<std::pair<std::array<int, 3>, int>> byNodes;
  for (std::size_t f = 0; f < faces.size(); ++f) {
    byNodes.push_back({faces[f].nodes, static_cast<int>(f)});
    std::sort(byNodes[f].first.begin(), byNodes[f].first.end());
  }
  std::sort(byNodes.begin(), byNodes.end());
  std::vector<char> isFirst(faces.size(), 0);
  int first = 0;
  for (std::size_t k = 0; k < byNodes.size(); ++k) {
    const auto& [nodes, f] = byNodes[k];
    if (k == 0 || nodes != byNodes[k - 1].first) first = f, isFirst[f] = 1;
    faces[first].q = std::min(faces[first].q, faces[f].q);
  }
  std::vector<Face> once;
  for (std::size_t f = 0; f < faces.size(); ++f)
    if (isFirst[f]) once.push_back(faces[f]);
  faces = once;
}

/// The bisection order, the last two vertices swapped where the tetrahedron would be negative in
/// the computational space. A mesh without that space keeps its order, inverted elements and all,
/// and its labels where it has any.
Cells cellsOf(const Mesh& M) {
  constexpr int outward[4][3] = {{1, 2, 3}, {0, 3, 2}, {0, 1, 3}, {0, 2, 1}};
  Cells C;
  C.tets = M.tets;
  C.q = qualities(M);
  if (M.faceLabel.empty()) return C;
  std::map<int, std::vector<Face>> inserted, boundary;
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    std::array<int, 4>& z = C.tets[E];
    std::array<int, 4> label = M.faceLabel[E];
    if (!M.xi.empty() && sixVolumes(M.xi, z) < 0) {
      std::swap(z[2], z[3]);
      std::swap(label[2], label[3]);
    }
    for (int i = 0; i < 4; ++i) {
      if (label[i] == 0) continue;
      const int* o = outward[i];
      auto& list = label[i] > 0 ? inserted[label[i]] : boundary[-label[i]];
      list.push_back({{z[o[0]], z[o[1]], z[o[2]]}, label[i], C.q[E]});
    }
  }
  for (auto& [k, faces] : inserted) {
    joinFaces(faces);
    orientSheet(M, faces);
    C.faces.insert(C.faces.end(), faces.begin(), faces.end());
  }
  for (auto& [p, faces] : boundary) C.faces.insert(C.faces.end(), faces.begin(), faces.end());
  return C;
}

void putField(Text& out, const std::vector<Array>& arrays) {
  out << "FIELD meccano " << static_cast<int>(arrays.size()) << "\n";
  for (const Array& a : arrays) {
    out << a.name << " " << a.components << " " << a.tuples() << (a.integer ? " int" : " double");
    for (std::size_t i = 0; i < a.values.size(); ++i) {
      out << (i % a.components == 0 ? "\n" : " ");
      if (a.integer)
        out << static_cast<int>(a.values[i]);
      else
        out << a.values[i];
    }
    out << "\n";
  }
}

void putCells(Text& out, const Cells& C) {
  const int tets = static_cast<int>(C.tets.size()), faces = static_cast<int>(C.faces.size());
  out << "CELLS " << tets + faces << " " << 5 * tets + 4 * faces << "\n";
  for (const std::array<int, 4>& z : C.tets)
    out << "4 " << z[0] << " " << z[1] << " " << z[2] << " " << z[3] << "\n";
  for (const Face& f : C.faces)
    out << "3 " << f.nodes[0] << " " << f.nodes[1] << " " << f.nodes[2] << "\n";
  out << "CELL_TYPES " << tets + faces << "\n";
  for (int i = 0; i < tets; ++i) out << "10\n";
  for (int i = 0; i < faces; ++i) out << "5\n";
}

/// One column of data with its head; `value` gives the number of each entry.
template <class Value>
void putScalars(Text& out, const char* head, std::size_t count, Value value) {
  out << "SCALARS " << head << "\nLOOKUP_TABLE default\n";
  for (std::size_t i = 0; i < count; ++i) out << value(i) << "\n";
}

void putCellData(Text& out, const Mesh& M, const Cells& C) {
  const std::size_t tets = C.tets.size(), all = tets + C.faces.size();
  out << "CELL_DATA " << static_cast<int>(all) << "\n";
  if (!M.faceLabel.empty())
    putScalars(out, "surface int", all,
               [&](std::size_t i) { return i < tets ? 0 : C.faces[i - tets].label; });
  if (!M.xi.empty())
    putScalars(out, "level int", all,
               [&](std::size_t i) { return i < tets ? int(M.level[i]) : -1; });
  putScalars(out, "quality double", all,
             [&](std::size_t i) { return i < tets ? C.q[i] : C.faces[i - tets].q; });
}

void putPointData(Text& out, const Mesh& M) {
  const std::size_t nodes = M.x.size();
  out << "POINT_DATA " << static_cast<int>(nodes) << "\nVECTORS computational double\n";
  for (Vec3 x : M.xi) out << x.x << " " << x.y << " " << x.z << "\n";
  putScalars(out, "dimension int", nodes, [&](std::size_t n) { return int(M.dimension[n]); });
  putScalars(out, "entity int", nodes, [&](std::size_t n) { return M.entity[n]; });
  out << "SCALARS parameter double 2\nLOOKUP_TABLE default\n";
  for (Vec2 u : M.parameter) out << u.x << " " << u.y << "\n";
}

/// The mesh as a VTK legacy file: a function of the mesh alone, and parseVtk() gives the mesh back.
std::string vtkText(const Mesh& M) {
  constexpr std::size_t perNode = 200, perTet = 80, head = 1000;  // bytes, seldom exceeded
  const Cells C = cellsOf(M);
  Text out(head + perNode * M.x.size() + perTet * M.tets.size());
  out << "# vtk DataFile Version 3.0\nmeccano mesh\nASCII\nDATASET UNSTRUCTURED_GRID\n";
  if (!M.xi.empty()) putField(out, packGeometry(M));
  out << "POINTS " << static_cast<int>(M.x.size()) << " double\n";
  for (Vec3 x : M.x) out << x.x << " " << x.y << " " << x.z << "\n";
  putCells(out, C);
  putCellData(out, M, C);
  if (!M.xi.empty()) putPointData(out, M);
  return out.take();
}

// ==== Meshes without a meccano: faces by their groups ===========================================

/// A triangle of a mesh file with the number of its group or its label.
struct TaggedFace {
  std::array<int, 3> nodes;
  int tag;
  int uses = 0;  // as a face of a tetrahedron
};

/// The triangles of a file by their nodes, to be found again among the faces of its tetrahedra.
class FaceIndex {
 public:
  std::vector<TaggedFace> faces;  // nodes ascending, in their order

  FaceIndex(const std::vector<TaggedFace>& list, std::size_t nodes) : faces(list), used_(nodes) {
    for (TaggedFace& f : faces) {
      for (int n : f.nodes) used_[n] = 1;
      std::sort(f.nodes.begin(), f.nodes.end());
    }
    std::stable_sort(faces.begin(), faces.end(), less);
  }
  /// Face i of the tetrahedron z, one use more of it; nullptr where the file has no such triangle.
  const TaggedFace* use(const std::array<int, 4>& z, int i) {
    TaggedFace key{{z[(i + 1) % 4], z[(i + 2) % 4], z[(i + 3) % 4]}, 0};
    for (int n : key.nodes)
      if (!used_[n]) return nullptr;
    std::sort(key.nodes.begin(), key.nodes.end());
    const auto at = std::lower_bound(faces.begin(), faces.end(), key, less);
    if (at == faces.end() || at->nodes != key.nodes) return nullptr;
    ++at->uses;
    return &*at;
  }

 private:
  static bool less(const TaggedFace& a, const TaggedFace& b) { return a.nodes < b.nodes; }
  std::vector<char> used_;  // [nodes]
};

/// A mesh as a file has it. Only .vtk files of meccano fill more than M's x, tets and faceLabel,
/// and the names in M.surfaces and M.patches.
struct MeshFile {
  Mesh M;
  std::vector<int> required;  // nodes that stay where they are: MEDIT's RequiredVertices
  std::vector<std::string> warnings;
};

/// Labels the faces that the file's triangles name: groups inside the mesh become surfaces 1, 2,
/// ..., groups on its boundary patches 1, 2, ..., both in the order of their numbers.
void labelByTags(MeshFile& file, const std::vector<TaggedFace>& faces,
                 const std::map<int, std::string>& names = {}) {
  if (faces.empty()) return;
  Mesh& M = file.M;
  FaceIndex index(faces, M.x.size());
  const std::vector<std::array<int, 4>> neighbour = faceNeighbours(M);
  M.faceLabel.assign(M.tets.size(), {0, 0, 0, 0});
  std::map<int, int> surfaces, patches;  // tag -> number
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int i = 0; i < 4; ++i) {
      const TaggedFace* f = index.use(M.tets[E], i);
      if (!f) continue;
      M.faceLabel[E][i] = neighbour[E][i] < 0 ? -f->tag : f->tag;
      (neighbour[E][i] < 0 ? patches : surfaces)[f->tag] = 0;
    }
  const auto number = [&](std::map<int, int>& tags, std::vector<Parametrization>& list,
                          const char* word) {
    for (auto& [tag, n] : tags) {
      n = static_cast<int>(list.size()) + 1;
      list.emplace_back();
      list.back().name = names.count(tag) ? names.at(tag) : word + std::to_string(n);
    }
  };
  number(surfaces, M.surfaces, "surface ");
  number(patches, M.patches, "patch ");
  for (std::array<int, 4>& labels : M.faceLabel)
    for (int& label : labels)
      label = label < 0 ? -patches[-label] : label > 0 ? surfaces[label] : 0;
  if (surfaces.empty() && patches.empty()) M.faceLabel.clear();
  const auto strays = std::count_if(index.faces.begin(), index.faces.end(),
                                    [](const TaggedFace& f) { return f.uses == 0; });
  if (strays > 0)
    file.warnings.push_back(std::to_string(strays) +
                            " triangles are no faces of its tetrahedra, or there twice: left out");
}

Vec3 readPoint(Scanner& in) {
  Vec3 x;
  x.x = in.number<double>("a coordinate");
  x.y = in.number<double>("a coordinate");
  x.z = in.number<double>("a coordinate");
  if (!isFinite(x)) in.failHere("a coordinate is not finite; correct it");
  return x;
}

// ==== VTK legacy: reading =======================================================================

/// What a VTK legacy file says, before it is a mesh.
struct VtkFile {
  std::vector<Vec3> points;
  std::vector<int> start, nodes, types;  // nodes of cell c: nodes[start[c] .. start[c+1])
  Arrays field, pointData, cellData;
};

Array readArray(Scanner& in, const std::string& name, int components, int tuples) {
  Array a;
  a.name = name;
  a.components = components;
  const std::size_t count = std::size_t(components) * tuples;
  in.checkRest(count, "numbers of array '" + name + "'");
  a.values.reserve(count);
  for (std::size_t i = 0; i < count; ++i) a.values.push_back(in.number<double>("a value"));
  return a;
}

void readField(Scanner& in, Arrays& to) {
  in.word("the name of the field");
  for (int arrays = in.count("arrays"); arrays > 0; --arrays) {
    const std::string name(in.word("the name of an array"));
    const int components = in.count("components"), tuples = in.count("tuples");
    if (components == 0) in.failHere("array '" + name + "' has no components; write the file anew");
    if (upper(in.word("the type of an array")) != "STRING") {
      to[name] = readArray(in, name, components, tuples);
      continue;
    }
    in.line();
    for (long long i = 0; i < 1LL * components * tuples && !in.consumed(); ++i) in.line();
  }
}

void readPoints(Scanner& in, VtkFile& file) {
  const int count = in.count("points");
  in.word("the type of the points");
  file.points.resize(count);
  for (Vec3& x : file.points) x = readPoint(in);
}

int readNode(Scanner& in, const VtkFile& file) {
  const int n = in.number<int>("a node"), count = static_cast<int>(file.points.size());
  if (n < 0 || n >= count)
    in.failHere("node " + std::to_string(n) + " does not exist, there are " +
                std::to_string(count) + " points; correct the index (they start at 0)");
  return n;
}

/// Cells as versions up to 4 write them: for each its number of nodes, and these.
void readCells(Scanner& in, VtkFile& file, int cells, int size) {
  file.start.assign(1, 0);
  for (int c = 0; c < cells; ++c) {
    for (int n = in.count("nodes of a cell"); n > 0; --n) file.nodes.push_back(readNode(in, file));
    file.start.push_back(static_cast<int>(file.nodes.size()));
  }
  if (static_cast<int>(file.nodes.size()) + cells != size)
    in.failHere("the cells take " + std::to_string(file.nodes.size() + cells) +
                " numbers, CELLS promises " + std::to_string(size) + "; write the file anew");
}

/// Cells as version 5 writes them: OFFSETS and CONNECTIVITY.
void readCells5(Scanner& in, VtkFile& file, int offsets, int size) {
  in.word("OFFSETS");
  in.word("the type of the offsets");
  for (int i = 0; i < offsets; ++i) file.start.push_back(in.number<int>("an offset"));
  if (offsets < 1 || file.start[0] != 0 || file.start.back() != size ||
      !std::is_sorted(file.start.begin(), file.start.end()))
    in.failHere("the offsets do not grow from 0 to " + std::to_string(size) +
                "; write the file anew");
  in.word("CONNECTIVITY");
  in.word("the type of the connectivity");
  for (int i = 0; i < size; ++i) file.nodes.push_back(readNode(in, file));
}

/// One attribute of the points or cells; false where the keyword is none.
bool readAttribute(Scanner& in, const std::string& key, Arrays& to, int count) {
  static const std::map<std::string, int> fixedSize{{"VECTORS", 3},    {"NORMALS", 3},
                                                    {"TENSORS", 9},    {"TENSORS6", 6},
                                                    {"GLOBAL_IDS", 1}, {"PEDIGREE_IDS", 1}};
  const auto fixed = fixedSize.find(key);
  if (fixed == fixedSize.end() && key != "SCALARS" && key != "LOOKUP_TABLE" &&
      key != "COLOR_SCALARS" && key != "TEXTURE_COORDINATES")
    return false;
  const std::string name(in.word("the name of an attribute"));
  int components = fixed == fixedSize.end() ? 1 : fixed->second;
  if (key == "LOOKUP_TABLE") {
    readArray(in, name, 4, in.count("colours of a table"));
    return true;
  }
  if (key == "COLOR_SCALARS" || key == "TEXTURE_COORDINATES") components = in.count("components");
  if (key != "COLOR_SCALARS") in.word("the type of an attribute");
  if (key == "SCALARS") {
    std::string next = upper(in.word("LOOKUP_TABLE"));
    if (parse(next, components)) next = upper(in.word("LOOKUP_TABLE"));
    if (next != "LOOKUP_TABLE") in.failHere("'" + next + "' is where LOOKUP_TABLE should be");
    in.word("the name of the table");
  }
  if (components < 1 || components > 9) in.failHere("an attribute has 1 to 9 components");
  to[name] = readArray(in, name, components, count);
  return true;
}

/// The two lines before the sections.
void readHead(Scanner& in) {
  if (in.atEnd()) in.failAsWhole("the file is empty; a VTK legacy mesh is needed");
  if (in.line().substr(0, 14) != "# vtk DataFile")
    in.failAsWhole(
        "this is no VTK legacy file (no '# vtk DataFile' in the first line); meshes are "
        "read from .vtk files");
  in.line();
  const std::string coding = upper(in.word("ASCII"));
  if (coding == "BINARY")
    in.failHere("this VTK file is binary; save it as ASCII (ParaView: Save Data, File Type Ascii)");
  if (coding != "ASCII") in.failHere("'" + coding.substr(0, 40) + "' is where ASCII should be");
}

void readCellSection(Scanner& in, VtkFile& file, bool version5) {
  const int cells = in.count("cells"), size = in.count("numbers of the cells");
  if (version5)
    readCells5(in, file, cells, size);
  else
    readCells(in, file, cells, size);
}

void readTypes(Scanner& in, VtkFile& file) {
  const int count = in.count("cell types");
  for (int i = 0; i < count; ++i) file.types.push_back(in.number<int>("a cell type"));
}

VtkFile readSections(Scanner& in, bool version5) {
  VtkFile file;
  Arrays* data = &file.field;
  int count = 0;
  while (!in.atEnd()) {
    const std::string key = upper(in.word("a section"));
    if (key == "DATASET") {
      if (upper(in.word("UNSTRUCTURED_GRID")) != "UNSTRUCTURED_GRID")
        in.failHere("the data set is no UNSTRUCTURED_GRID; a tetrahedral mesh is needed");
    } else if (key == "POINTS") {
      readPoints(in, file);
    } else if (key == "CELLS") {
      if (!file.start.empty()) in.failHere("a second CELLS section; write the file anew");
      readCellSection(in, file, version5);
    } else if (key == "CELL_TYPES") {
      readTypes(in, file);
    } else if (key == "POINT_DATA" || key == "CELL_DATA") {
      data = key == "POINT_DATA" ? &file.pointData : &file.cellData;
      const std::size_t due = key == "POINT_DATA" ? file.points.size() : file.types.size();
      count = in.count("data");
      if (static_cast<std::size_t>(count) != due)
        in.failHere(key + " is for " + std::to_string(count) + ", the mesh has " +
                    std::to_string(due));
    } else if (key == "FIELD") {
      readField(in, *data);
    } else if (key == "METADATA") {
      in.line();
      while (!in.consumed() && !in.line().empty()) continue;
    } else if (!readAttribute(in, key, *data, count)) {
      in.failHere("'" + key.substr(0, 40) +
                  "' is no section of a VTK legacy mesh; the file is damaged");
    }
  }
  if (file.start.size() != file.types.size() + 1 || file.types.empty())
    in.failAsWhole("it has " + std::to_string(file.start.empty() ? 0 : file.start.size() - 1) +
                   " cells and " + std::to_string(file.types.size()) +
                   " cell types; the file is truncated or holds no mesh");
  return file;
}

/// Puts the tetrahedra of the file into the mesh; returns the cell each came from.
std::vector<int> takeTetrahedra(const VtkFile& file, Mesh& M, const Scanner& in) {
  constexpr int tetrahedron = 10, lastPlane = 9;  // VTK's types 1 to 9 are points, lines and faces
  std::vector<int> cell;
  for (std::size_t c = 0; c < file.types.size(); ++c) {
    const int type = file.types[c], size = file.start[c + 1] - file.start[c];
    if (type >= 1 && type <= lastPlane) continue;
    if (type != tetrahedron || size != 4)
      in.failAsWhole("cell " + std::to_string(c) + " is of type " + std::to_string(type) +
                     " with " + std::to_string(size) +
                     " nodes; only tetrahedra (type 10) can be treated");
    const int* n = &file.nodes[file.start[c]];
    for (int i = 0; i < 4; ++i)
      for (int j = 0; j < i; ++j)
        if (n[i] == n[j]) in.failAsWhole("cell " + std::to_string(c) + " names a node twice");
    M.tets.push_back({n[0], n[1], n[2], n[3]});
    cell.push_back(static_cast<int>(c));
  }
  if (M.tets.empty()) in.failAsWhole("no tetrahedron in it; a tetrahedral mesh is needed");
  return cell;
}

/// In the computational space the refinement edge z0 z1 is the longest, and z2 is farther from z0
/// than z3 is: for all three types, as their edges show. So the file gives that order back.
void orderForBisection(Mesh& M, const Scanner& in) {
  // squares of the edges 01 02 03 12 13 23, by the cube's edge at this level
  constexpr double kuhn[3][6] = {
      {3, 2, 1, 1, 2, 1}, {2, 1, .75, 1, .75, .75}, {1, .75, .5, .75, .5, .25}};
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    std::array<int, 4>& z = M.tets[E];
    auto edge2 = [&](int i, int j) { return norm2(M.xi[z[i]] - M.xi[z[j]]); };
    if (edge2(0, 2) < edge2(0, 3)) std::swap(z[2], z[3]);
    M.type.push_back(static_cast<unsigned char>(M.level[E] % 3));
    const double* due = kuhn[M.type[E]];
    const double cube = std::ldexp(1.0, -(M.level[E] / 3)), cube2 = cube * cube;
    const double is[6] = {edge2(0, 1), edge2(0, 2), edge2(0, 3),
                          edge2(1, 2), edge2(1, 3), edge2(2, 3)};
    bool good = true;
    for (int i = 0; i < 6; ++i) good &= is[i] == due[i] * cube2;  // exact: few binary digits
    for (int n : z)
      for (double t : {M.xi[n].x, M.xi[n].y, M.xi[n].z}) {
        const double halves = t / (.5 * cube);  // exact
        good &= halves == std::floor(halves);
      }
    if (!good)
      in.failAsWhole("the computational coordinates of tetrahedron " + std::to_string(E) +
                     " are not those of a bisected cube at its level " +
                     std::to_string(M.level[E]) + "; use the file as meccano wrote it");
  }
}

bool isTriangle(const VtkFile& file, std::size_t c) {
  constexpr int triangle = 5;
  return file.types[c] == triangle && file.start[c + 1] - file.start[c] == 3;
}

/// The nodes of a triangle.
std::array<int, 3> cornersOf(const VtkFile& file, std::size_t c) {
  const int first = file.start[c];
  return {file.nodes[first], file.nodes[first + 1], file.nodes[first + 2]};
}

/// Finds the file's triangles among the faces, and refuses a boundary without its patches.
void labelFaces(const VtkFile& file, Mesh& M, const Scanner& in) {
  std::vector<TaggedFace> triangles;
  Unpacking surface(file.cellData, "surface", 1, in);
  for (std::size_t c = 0; c < file.types.size(); ++c) {
    const int label = surface.integer(-static_cast<int>(M.patches.size()), INT_MAX);
    if (isTriangle(file, c)) triangles.push_back({cornersOf(file, c), label});
  }
  FaceIndex index(triangles, M.x.size());
  const std::vector<std::array<int, 4>> neighbour = faceNeighbours(M);
  M.faceLabel.assign(M.tets.size(), {0, 0, 0, 0});
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int i = 0; i < 4; ++i) {
      const TaggedFace* f = index.use(M.tets[E], i);
      const int label = f ? f->tag : 0;
      const bool boundary = neighbour[E][i] < 0;
      if (boundary != (label < 0))
        in.failAsWhole("face " + std::to_string(i) + " of tetrahedron " + std::to_string(E) +
                       (boundary ? " lies on the boundary, and no patch is named for it"
                                 : " lies inside, and is named as one of the boundary") +
                       "; use the file as meccano wrote it");
      M.faceLabel[E][i] = label;
    }
  for (const TaggedFace& f : index.faces)  // one that is there twice has no use the second time
    if (f.uses != (f.tag > 0 ? 2 : 1))
      in.failAsWhole("the triangle of nodes " + std::to_string(f.nodes[0]) + " " +
                     std::to_string(f.nodes[1]) + " " + std::to_string(f.nodes[2]) +
                     " is no face of the mesh, or there twice; use the file as meccano wrote it");
}

/// The data of the nodes; each entity must be one that the file has.
void readNodes(const VtkFile& file, Mesh& M, const Scanner& in) {
  const Arrays& data = file.pointData;
  Unpacking xi(data, "computational", 3, in), dimension(data, "dimension", 1, in),
      entity(data, "entity", 1, in), parameter(data, "parameter", 2, in);
  const int patches = static_cast<int>(M.patches.size());
  const int high[4] = {static_cast<int>(M.corners.size()), static_cast<int>(M.curves.size()),
                       static_cast<int>(M.surfaces.size()), 0};
  for (std::size_t n = 0; n < M.x.size(); ++n) {
    M.xi.push_back(xi.vec3());
    const int d = dimension.integer(0, 3);
    M.dimension.push_back(static_cast<unsigned char>(d));
    M.entity.push_back(entity.integer(d == 3 ? 0 : d == 2 ? -patches : 1, high[d]));
    if (d < 3 && M.entity.back() == 0)
      in.failAsWhole("node " + std::to_string(n) + " is on no surface, its dimension is 2");
    M.parameter.push_back(parameter.vec2());
  }
}

/// The triangles of a file without a meccano by its array `surface`, where that is one of labels.
void labelPlain(const VtkFile& file, Mesh& M) {
  const auto found = file.cellData.find("surface");
  if (found == file.cellData.end() || found->second.values.size() != file.types.size()) return;
  MeshFile labelled;
  std::vector<TaggedFace> faces;
  for (std::size_t c = 0; c < file.types.size(); ++c) {
    const double label = std::abs(found->second.values[c]);
    const bool good = label >= 1 && label < INT_MAX && label == std::floor(label);
    if (good && isTriangle(file, c)) faces.push_back({cornersOf(file, c), static_cast<int>(label)});
  }
  std::swap(labelled.M, M);
  labelByTags(labelled, faces);
  std::swap(labelled.M, M);
}

/// A mesh from a VTK legacy file: with its meccano where the file has one, else x, tets and labels.
Mesh parseVtk(const std::string& name, const std::string& text) {
  Scanner in(name, text);
  const bool version5 = text.compare(0, 24, "# vtk DataFile Version 5") == 0;
  readHead(in);
  const VtkFile file = readSections(in, version5);
  Mesh M;
  M.x = file.points;
  const std::vector<int> cell = takeTetrahedra(file, M, in);
  if (!file.field.count("cube") && !file.pointData.count("computational")) {
    labelPlain(file, M);
    return M;
  }
  if (text.back() != '\n') in.failAsWhole("the last line is not complete; the file is truncated");
  Unpacking cube(file.field, "cube", 3, in);
  M.cube = cube.vec3();
  unpackSurfaces(file.field, M, in);
  unpackCurves(file.field, M, in);
  unpackCorners(file.field, M, in);
  readNodes(file, M, in);
  constexpr int maxLevel = 250;
  Unpacking level(file.cellData, "level", 1, in);
  std::vector<int> levels;
  for (std::size_t c = 0; c < file.types.size(); ++c) levels.push_back(level.integer(-1, maxLevel));
  for (int c : cell) {
    if (levels[c] < 0) in.failAsWhole("tetrahedron " + std::to_string(c) + " has no level");
    M.level.push_back(static_cast<unsigned char>(levels[c]));
  }
  orderForBisection(M, in);
  labelFaces(file, M, in);
  return M;
}

// ==== Meshes without a meccano: labels ==========================================================

/// The nodes of labelled faces inside a mesh that has no geometry for them.
std::vector<int> interfaceNodes(const Mesh& M) {
  std::vector<int> nodes;
  if (!M.dimension.empty()) return nodes;
  for (int k = 1; k <= static_cast<int>(M.surfaces.size()); ++k)
    for (const std::array<int, 3>& f : surfaceFaces(M, k))
      nodes.insert(nodes.end(), f.begin(), f.end());
  std::sort(nodes.begin(), nodes.end());
  nodes.erase(std::unique(nodes.begin(), nodes.end()), nodes.end());
  return nodes;
}

/// The name of the surface or patch with this label, as other programs see it.
std::string labelName(const Mesh& M, int label) {
  const std::vector<Parametrization>& list = label > 0 ? M.surfaces : M.patches;
  const std::size_t k = std::abs(label);
  if (k <= list.size() && !list[k - 1].name.empty()) return list[k - 1].name;
  return (label > 0 ? "surface " : "patch ") + std::to_string(k);
}

/// Group numbers in .msh and .mesh, all > 0: surfaces keep theirs, the patches follow.
int surfaceGroups(const Mesh& M, const Cells& C) {
  int highest = static_cast<int>(M.surfaces.size());
  for (const Face& f : C.faces) highest = std::max(highest, f.label);
  return highest;
}

int groupOf(int label, int surfaces) { return label > 0 ? label : surfaces - label; }

/// A tetrahedron of a file; its vertices are four nodes.
void addTetrahedron(Mesh& M, const std::array<int, 4>& z, const Scanner& in) {
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < i; ++j)
      if (z[i] == z[j])
        in.failHere("tetrahedron " + std::to_string(M.tets.size()) +
                    " names a node twice; correct the mesh");
  M.tets.push_back(z);
}

// ==== Gmsh MSH 2.2 ==============================================================================

constexpr int gmshTriangle = 2, gmshTetrahedron = 4;

/// ASCII 2.2: a physical group with its name for the volume, each surface and each patch.
std::string mshText(const Mesh& M) {
  const Cells C = cellsOf(M);
  const int surfaces = surfaceGroups(M, C);
  std::set<int> labels;
  for (const Face& f : C.faces) labels.insert(f.label);
  Text out;
  out << "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n"
      << static_cast<int>(labels.size()) + 1 << "\n";
  std::map<int, int> inOrder;  // group -> label
  for (int label : labels) inOrder[groupOf(label, surfaces)] = label;
  std::set<std::string> taken{"volume"};
  for (const auto& [group, label] : inOrder) {
    std::string name = labelName(M, label);
    for (char& c : name)
      if (c == '"' || static_cast<unsigned char>(c) < ' ') c = '\'';
    if (!taken.insert(name).second) name += " (" + std::to_string(group) + ")";
    out << "2 " << group << " \"" << name << "\"\n";
  }
  out << "3 1 \"volume\"\n$EndPhysicalNames\n$Nodes\n" << static_cast<int>(M.x.size()) << "\n";
  for (std::size_t n = 0; n < M.x.size(); ++n)
    out << static_cast<int>(n) + 1 << " " << M.x[n].x << " " << M.x[n].y << " " << M.x[n].z << "\n";
  out << "$EndNodes\n$Elements\n" << static_cast<int>(C.faces.size() + C.tets.size()) << "\n";
  int element = 0;  // number, element type, two tags (physical group, geometric entity), nodes
  for (const Face& f : C.faces) {
    const int group = groupOf(f.label, surfaces);
    out << ++element << " " << gmshTriangle << " 2 " << group << " " << group;
    for (int n : f.nodes) out << " " << n + 1;
    out << "\n";
  }
  for (const std::array<int, 4>& z : C.tets) {
    out << ++element << " " << gmshTetrahedron << " 2 1 1";
    for (int n : z) out << " " << n + 1;
    out << "\n";
  }
  out << "$EndElements\n";
  return out.take();
}

/// What is read of a .msh file; nodes have numbers of any kind in it.
struct MshReader {
  MeshFile file;
  std::unordered_map<int, int> node;  // of a number
  std::vector<TaggedFace> faces;
  std::map<int, std::string> names;  // of two-dimensional groups
  std::set<int> regions;

  void head(Scanner& in) {
    const double version = in.number<double>("the version");
    const int binary = in.number<int>("the file type");
    in.number<int>("the size of a number");
    if (version < 2 || version >= 3 || binary != 0)
      in.failHere("this Gmsh file is " + std::string(binary ? "binary" : "ASCII") + " version " +
                  format("%.2g", version) +
                  "; save it as ASCII version 2.2 (gmsh -save -format msh22)");
  }
  void physicalNames(Scanner& in) {
    for (int i = in.count("physical names"); i > 0; --i) {
      const int dimension = in.number<int>("a dimension"), tag = in.number<int>("a group");
      const std::string_view rest = in.line();
      const std::size_t from = rest.find('"'), to = rest.rfind('"');
      if (from == to) in.failHere("a physical name is written in \"quotes\"; add them");
      if (dimension == 2) names[tag] = rest.substr(from + 1, to - from - 1);
    }
  }
  void nodes(Scanner& in) {
    for (int i = in.count("nodes"); i > 0; --i) {
      const int number = in.number<int>("the number of a node");
      if (!node.insert({number, static_cast<int>(file.M.x.size())}).second)
        in.failHere("node " + std::to_string(number) + " is there twice; renumber one");
      file.M.x.push_back(readPoint(in));
    }
  }
  int readNode(Scanner& in) {
    const int number = in.number<int>("a node");
    const auto found = node.find(number);
    if (found == node.end())
      in.failHere("node " + std::to_string(number) +
                  " does not exist; correct the number, or put $Nodes before $Elements");
    return found->second;
  }
  void elements(Scanner& in) {
    constexpr int flat[] = {1, 2, 3, 8, 9, 10, 15, 16, 20, 21, 26};  // points, lines and faces
    for (int i = in.count("elements"); i > 0; --i) {
      in.number<int>("the number of an element");
      const int type = in.number<int>("the type of an element");
      int group = 0;
      for (int tags = in.count("tags"), t = 0; t < tags; ++t) {
        const int tag = in.number<int>("a tag");
        if (t == 0 || (t == 1 && group == 0)) group = tag;  // physical, else geometric
      }
      if (type == gmshTetrahedron) {
        const int a = readNode(in), b = readNode(in), c = readNode(in);
        addTetrahedron(file.M, {a, b, c, readNode(in)}, in);
        regions.insert(group);
      } else if (type == gmshTriangle) {
        const int a = readNode(in), b = readNode(in);
        const TaggedFace f{{a, b, readNode(in)}, group};
        if (group > 0) faces.push_back(f);
      } else if (std::find(std::begin(flat), std::end(flat), type) == std::end(flat)) {
        in.failHere("an element of type " + std::to_string(type) +
                    "; only tetrahedra of four nodes (type 4) can be treated");
      } else {
        in.line();
      }
    }
  }
};

void checkTetrahedra(MeshFile& file, const std::set<int>& regions, const Scanner& in) {
  if (file.M.tets.empty()) in.failAsWhole("no tetrahedron in it; a tetrahedral mesh is needed");
  if (regions.size() > 1)
    file.warnings.push_back("its " + std::to_string(regions.size()) +
                            " regions of tetrahedra become one: regions are not kept");
}

MeshFile parseMsh(const std::string& name, const std::string& text) {
  Scanner in(name, text);
  if (hasByteOrderMark(text)) in.skip(3);
  MshReader r;
  while (!in.atEnd()) {
    const std::string section(in.word("a section"));
    if (section[0] != '$')
      in.failHere("'" + section.substr(0, 40) + "' is where a section ($...) should be");
    if (section == "$MeshFormat")
      r.head(in);
    else if (section == "$PhysicalNames")
      r.physicalNames(in);
    else if (section == "$Nodes")
      r.nodes(in);
    else if (section == "$Elements")
      r.elements(in);
    const std::string end = "$End" + section.substr(1);
    const bool known = section == "$MeshFormat" || section == "$PhysicalNames" ||
                       section == "$Nodes" || section == "$Elements";
    std::string_view word = in.word(end.c_str());
    while (!known && word != end) word = in.word(end.c_str());
    if (word != end)
      in.failHere("'" + std::string(word.substr(0, 40)) + "' is where " + end + " should be");
  }
  checkTetrahedra(r.file, r.regions, in);
  labelByTags(r.file, r.faces, r.names);
  return std::move(r.file);
}

// ==== MEDIT .mesh ===============================================================================

/// Version 2 (double precision): references of triangles are the groups, of tetrahedra 1.
std::string meditText(const Mesh& M, const std::vector<int>& required) {
  const Cells C = cellsOf(M);
  const int surfaces = surfaceGroups(M, C);
  Text out;
  out << "MeshVersionFormatted 2\n\nDimension 3\n\nVertices\n"
      << static_cast<int>(M.x.size()) << "\n";
  for (Vec3 x : M.x) out << x.x << " " << x.y << " " << x.z << " 0\n";
  out << "\nTetrahedra\n" << static_cast<int>(C.tets.size()) << "\n";
  for (const std::array<int, 4>& z : C.tets) {
    for (int n : z) out << n + 1 << " ";
    out << "1\n";
  }
  if (!C.faces.empty()) out << "\nTriangles\n" << static_cast<int>(C.faces.size()) << "\n";
  for (const Face& f : C.faces) {
    for (int n : f.nodes) out << n + 1 << " ";
    out << groupOf(f.label, surfaces) << "\n";
  }
  std::vector<int> corners;
  for (std::size_t n = 0; n < M.dimension.size(); ++n)
    if (M.dimension[n] == 0) corners.push_back(static_cast<int>(n));
  const std::pair<const char*, const std::vector<int>*> lists[] = {{"Corners", &corners},
                                                                   {"RequiredVertices", &required}};
  for (const auto& [head, nodes] : lists) {
    if (!nodes->empty()) out << "\n" << head << "\n" << static_cast<int>(nodes->size()) << "\n";
    for (int n : *nodes) out << n + 1 << "\n";
  }
  out << "\nEnd\n";
  return out.take();
}

int meditNode(Scanner& in, const Mesh& M) {
  const int n = in.number<int>("a node"), count = static_cast<int>(M.x.size());
  if (n < 1 || n > count)
    in.failHere("node " + std::to_string(n) + " does not exist, there are " +
                std::to_string(count) + " vertices; correct the index (they start at 1)");
  return n - 1;
}

/// The entries of a section; what is no vertex, tetrahedron, triangle or required vertex is
/// skipped.
void readMeditSection(Scanner& in, const std::string& key, MeshFile& file,
                      std::vector<TaggedFace>& faces, std::set<int>& regions) {
  Mesh& M = file.M;
  const bool solid = key.compare(0, 4, "Hexa") == 0 || key.compare(0, 5, "Prism") == 0 ||
                     key.compare(0, 7, "Pyramid") == 0 || key.compare(0, 12, "TetrahedraP2") == 0;
  if (solid)
    in.failHere(key.substr(0, 40) + " are in it; only tetrahedra of four nodes can be treated");
  const bool vertices = key == "Vertices", tetrahedra = key == "Tetrahedra";
  const bool triangles = key == "Triangles", required = key == "RequiredVertices";
  const bool isRead = vertices || tetrahedra || triangles || required;
  for (int count = isRead ? in.count("entries of a section") : 0; count > 0; --count) {
    if (required) {
      file.required.push_back(meditNode(in, M));
      continue;
    }
    if (vertices) {
      M.x.push_back(readPoint(in));
    } else {
      const int a = meditNode(in, M), b = meditNode(in, M), c = meditNode(in, M);
      if (triangles) faces.push_back({{a, b, c}, 0});
      if (tetrahedra) addTetrahedron(M, {a, b, c, meditNode(in, M)}, in);
    }
    const int reference = in.number<int>("a reference");
    if (tetrahedra) regions.insert(reference);
    if (triangles) faces.back().tag = reference;
  }
}

MeshFile parseMedit(const std::string& name, const std::string& text) {
  Scanner in(name, text, '#');
  if (hasByteOrderMark(text)) in.skip(3);
  MeshFile file;
  std::vector<TaggedFace> faces;
  std::set<int> regions;
  in.word("MeshVersionFormatted");
  in.number<int>("the version");
  bool ended = false;
  while (!ended && !in.atEnd()) {
    const std::string key(in.word("a section"));
    const bool isWord = (key[0] >= 'A' && key[0] <= 'Z') || (key[0] >= 'a' && key[0] <= 'z');
    if (!isWord) continue;  // numbers of a section that is skipped
    ended = key == "End";
    if (key == "Dimension" && in.number<int>("the dimension") != 3)
      in.failHere("the dimension is not 3; a tetrahedral mesh is needed");
    readMeditSection(in, key, file, faces, regions);
  }
  if (!ended) in.failAsWhole("the file has no End; it is truncated");
  checkTetrahedra(file, regions, in);
  const auto none = [](const TaggedFace& f) { return f.tag <= 0; };
  faces.erase(std::remove_if(faces.begin(), faces.end(), none), faces.end());
  labelByTags(file, faces);
  return file;
}

// ==== Meshes and surfaces by their format =======================================================

MeshFile parseMesh(const std::string& path, const std::string& text) {
  const Format f = formatOf(path, text);
  if (f == Format::msh) return parseMsh(path, text);
  if (f == Format::medit) return parseMedit(path, text);
  if (f == Format::vtk || text.find_first_not_of(" \t\r\n") == std::string::npos) {
    MeshFile file;
    file.M = parseVtk(path, text);
    return file;
  }
  if (f != Format::none)
    fail(path + ": this is a surface (" + nameOf(f) + "), and a mesh is needed; name a mesh");
  fail(path +
       ": its content is of no known format; meshes are read from VTK legacy, Gmsh 2.2 and " +
       "MEDIT files, all ASCII");
}

/// The errors of the library's own checks get the file's name.
MeshFile readMeshFile(const std::string& path) {
  const std::string text = readFile(path);
  try {
    MeshFile file = parseMesh(path, text);
    for (std::string& w : file.warnings) w = path + ": " + w;
    return file;
  } catch (const Error& e) {
    const std::string what = e.what();
    throw InputError(what.compare(0, path.size(), path) == 0 ? what : path + ": " + what);
  }
}

Mesh readMesh(const std::string& path) { return readMeshFile(path).M; }

constexpr const char* meshSuffixes = ".vtk, .msh or .mesh";
constexpr const char* surfaceSuffixes = ".obj, .stl, .off, .ply or .ts";

std::string suffixOf(const std::string& path) { return lower(fs::path(path).extension().string()); }

bool isMeshSuffix(const std::string& s) { return s == ".vtk" || s == ".msh" || s == ".mesh"; }
bool isSurfaceSuffix(const std::string& s) {
  return s == ".obj" || s == ".stl" || s == ".off" || s == ".ply" || s == ".ts";
}

/// The mesh in the format of the path's suffix; a device gets VTK.
std::string meshText(const std::string& path, const Mesh& M,
                     const std::vector<int>& required = {}) {
  const std::string suffix = suffixOf(path);
  if (suffix == ".msh") return mshText(M);
  if (suffix == ".mesh") return meditText(M, required);
  return vtkText(M);
}

// ---- surfaces out ------------------------------------------------------------------------------

/// All in one, as formats of one object need it.
TriangleSurface joined(const std::vector<TriangleSurface>& all) {
  TriangleSurface S;
  for (const TriangleSurface& part : all) {
    const int first = static_cast<int>(S.points.size());
    S.points.insert(S.points.end(), part.points.begin(), part.points.end());
    for (const std::array<int, 3>& t : part.triangles)
      S.triangles.push_back({first + t[0], first + t[1], first + t[2]});
  }
  return S;
}

std::string objText(const std::vector<TriangleSurface>& all) {
  Text out;
  int first = 1;
  for (const TriangleSurface& S : all) {
    out << "o " << S.name << "\n";
    for (Vec3 x : S.points) out << "v " << x.x << " " << x.y << " " << x.z << "\n";
    for (const std::array<int, 3>& t : S.triangles)
      out << "f " << first + t[0] << " " << first + t[1] << " " << first + t[2] << "\n";
    first += static_cast<int>(S.points.size());
  }
  return out.take();
}

std::string gocadText(const std::vector<TriangleSurface>& all) {
  Text out;
  for (const TriangleSurface& S : all) {
    out << "GOCAD TSurf 1\nHEADER {\nname:" << S.name << "\n}\n"
        << "GOCAD_ORIGINAL_COORDINATE_SYSTEM\nNAME Default\nAXIS_NAME \"X\" \"Y\" \"Z\"\n"
        << "ZPOSITIVE Elevation\nEND_ORIGINAL_COORDINATE_SYSTEM\nTFACE\n";
    int id = 0;
    for (Vec3 x : S.points)
      out << "VRTX " << ++id << " " << x.x << " " << x.y << " " << x.z << "\n";
    for (const std::array<int, 3>& t : S.triangles)
      out << "TRGL " << t[0] + 1 << " " << t[1] + 1 << " " << t[2] + 1 << "\n";
    out << "END\n";
  }
  return out.take();
}

/// OFF and ASCII PLY: a head, the points, the triangles.
std::string listText(const std::string& head, const TriangleSurface& S) {
  Text out;
  out << head;
  for (Vec3 x : S.points) out << x.x << " " << x.y << " " << x.z << "\n";
  for (const std::array<int, 3>& t : S.triangles)
    out << "3 " << t[0] << " " << t[1] << " " << t[2] << "\n";
  return out.take();
}

/// The nearest float. Volatile: g++ 12 -O2 drops the rounding of double(float(v)) in pairs.
float nearestFloat(double v) {
  volatile float f = static_cast<float>(v);
  return f;
}

void putLittleEndian(std::string& text, std::uint32_t value, int bytes) {
  for (int i = 0; i < bytes; ++i) text += static_cast<char>(value >> 8 * i & 255);
}

std::string stlText(const TriangleSurface& S) {
  std::string text = "binary STL written by meccano";
  text.resize(80, ' ');
  putLittleEndian(text, static_cast<std::uint32_t>(S.triangles.size()), 4);
  for (const std::array<int, 3>& t : S.triangles) {
    const Vec3 a = S.points[t[0]], b = S.points[t[1]], c = S.points[t[2]];
    const Vec3 normal = cross(b - a, c - a);
    const double length = norm(normal);
    for (Vec3 x : {length > 0 ? (1 / length) * normal : Vec3{}, a, b, c})
      for (double v : {x.x, x.y, x.z}) {
        const float f = nearestFloat(v);
        std::uint32_t bits = 0;
        std::memcpy(&bits, &f, 4);
        putLittleEndian(text, bits, 4);
      }
    putLittleEndian(text, 0, 2);
  }
  return text;
}

/// Surfaces in the format of the path's suffix; what it cannot hold is warned of.
std::string surfaceText(const std::string& path, const std::vector<TriangleSurface>& all,
                        std::vector<std::string>& warnings) {
  const std::string suffix = suffixOf(path);
  if (suffix == ".obj") return objText(all);
  if (suffix == ".ts") return gocadText(all);
  if (all.size() > 1)
    warnings.push_back(path + ": its " + std::to_string(all.size()) +
                       " surfaces are written as one; .ts and .obj keep them apart");
  const TriangleSurface S = joined(all);
  const std::string points = std::to_string(S.points.size());
  const std::string triangles = std::to_string(S.triangles.size());
  if (suffix == ".off") return listText("OFF\n" + points + " " + triangles + " 0\n", S);
  if (suffix == ".ply")
    return listText("ply\nformat ascii 1.0\nelement vertex " + points +
                        "\nproperty double x\nproperty double y\nproperty double z\nelement face " +
                        triangles + "\nproperty list uchar int vertex_indices\nend_header\n",
                    S);
  double change = 0;
  for (Vec3 x : S.points)
    for (double v : {x.x, x.y, x.z}) change = std::max(change, std::abs(v - nearestFloat(v)));
  if (!std::isfinite(change)) fail(path + ": a coordinate is too large for STL; write .obj or .ts");
  if (change > 0)
    warnings.push_back(path + ": STL has single precision, coordinates change by up to " +
                       format("%.2g", change) + "; .obj, .off, .ply and .ts keep them");
  return stlText(S);
}

/// The inserted surfaces of a mesh, S_M: one for each label.
std::vector<TriangleSurface> insertedSurfaces(const std::string& path, const Mesh& M) {
  std::vector<TriangleSurface> all;
  std::map<int, int> point;  // of a node, in the surface at hand
  int label = 0;
  for (const Face& f : cellsOf(M).faces) {
    if (f.label < 0) continue;
    if (f.label != label) {
      label = f.label;
      all.push_back({{}, {}, labelName(M, label)});
      point.clear();
    }
    std::array<int, 3> t{};
    for (int i = 0; i < 3; ++i) {
      const auto [at, isNew] = point.insert({f.nodes[i], static_cast<int>(point.size())});
      if (isNew) all.back().points.push_back(M.x[f.nodes[i]]);
      t[i] = at->second;
    }
    all.back().triangles.push_back(t);
  }
  if (all.empty()) fail(path + ": no surface is inserted in this mesh; write it as a mesh");
  return all;
}

// ==== Pictures ==================================================================================
// The tetrahedra behind a cut plane, whole, as Figures 8 and 11 show them: the faces between what
// is shown and what is left out, in parallel projection, coloured, shaded by their normals, as SVG.
// An item buffer tells which faces are seen; those are painted from back to front.

enum class Colour { quality, level, surface };

/// The plane x, y or z (axis 0, 1, 2) = value.
struct Cut {
  int axis = 1;
  double value = 0;
};

struct Segment {
  Vec3 a, b;
};

struct PictureOptions {
  Cut cut;
  Colour colour = Colour::quality;
  std::string title;
  std::vector<Segment> line = {};  // drawn in bold over the mesh: where a surface will come
};

using Triangle3 = std::array<Vec3, 3>;

struct Box {
  Vec3 low, high;
  void add(Vec3 x) {
    low = {std::min(low.x, x.x), std::min(low.y, x.y), std::min(low.z, x.z)};
    high = {std::max(high.x, x.x), std::max(high.y, x.y), std::max(high.z, x.z)};
  }
};

Box boxOf(const std::vector<Vec3>& points) {
  Box box{points.front(), points.front()};
  for (Vec3 x : points) box.add(x);
  return box;
}

constexpr const char* axisNames = "xyz";

double component(Vec3 x, int axis) { return axis == 0 ? x.x : axis == 1 ? x.y : x.z; }

std::string nameOf(const Cut& cut) {
  return std::string(1, axisNames[cut.axis]) + " = " + format("%.6g", cut.value);
}

/// The eye is before the plane, where x is high, y low, z high; shown is what is behind.
bool isBehind(const Cut& cut, Vec3 x) {
  return (component(x, cut.axis) - cut.value) * (cut.axis == 1 ? 1 : -1) >= 0;
}

/// Quarters of the undeformed cubes, as long as they stay within the box: there the cut is flat.
void snapToCubes(Cut& cut, const Mesh& M, const Box& within) {
  const double quarter = .25 * component(M.cube, cut.axis),
               low = component(boxOf(M.x).low, cut.axis);
  const double snapped = low + quarter * std::round((cut.value - low) / quarter);
  if (!M.xi.empty() && snapped > component(within.low, cut.axis) &&
      snapped < component(within.high, cut.axis))
    cut.value = snapped;
}

/// Through the middle of the triangles, normal to the axis y, x or z (the first of equals) that is
/// most nearly tangential to them, so that the cut shows them as a line; without any through the
/// middle of the mesh, normal to y.
Cut defaultCut(const std::vector<Triangle3>& triangles, const Mesh& M) {
  constexpr double equal = 1e-9;  // relative: rounding of the sums
  const Box mesh = boxOf(M.x);
  Cut cut{1, .5 * (mesh.low.y + mesh.high.y)};
  if (triangles.empty()) return cut;
  Box box{triangles[0][0], triangles[0][0]};
  std::array<double, 3> across{0, 0, 0};  // sum of areas seen along the axis
  for (const Triangle3& t : triangles) {
    for (Vec3 x : t) box.add(x);
    const Vec3 n = cross(t[1] - t[0], t[2] - t[0]);
    for (int i = 0; i < 3; ++i) across[i] += std::abs(component(n, i));
  }
  const double sum = across[0] + across[1] + across[2];
  for (int i : {0, 2})
    if (across[i] < across[cut.axis] - equal * sum) cut.axis = i;
  cut.value = .5 * (component(box.low, cut.axis) + component(box.high, cut.axis));
  snapToCubes(cut, M, box);
  const double low = component(mesh.low, cut.axis), high = component(mesh.high, cut.axis);
  if (!(cut.value > low && cut.value < high)) cut.value = .5 * (low + high);
  return cut;
}

std::vector<Triangle3> trianglesOf(const TriangleSurface& S) {
  std::vector<Triangle3> all;
  for (const std::array<int, 3>& t : S.triangles)
    all.push_back({S.points[t[0]], S.points[t[1]], S.points[t[2]]});
  return all;
}

/// The faces of all inserted surfaces.
std::vector<Triangle3> insertedTriangles(const Mesh& M) {
  std::vector<Triangle3> all;
  for (std::size_t E = 0; E < M.faceLabel.size(); ++E)
    for (int i = 0; i < 4; ++i) {
      if (M.faceLabel[E][i] <= 0) continue;
      const std::array<int, 4>& z = M.tets[E];
      all.push_back({M.x[z[(i + 1) % 4]], M.x[z[(i + 2) % 4]], M.x[z[(i + 3) % 4]]});
    }
  return all;
}

/// Where the triangles cross the plane.
std::vector<Segment> sectionOf(const std::vector<Triangle3>& triangles, const Cut& cut) {
  std::vector<Segment> line;
  for (const Triangle3& t : triangles) {
    std::vector<Vec3> ends;
    for (int i = 0; i < 3; ++i) {
      const Vec3 a = t[i], b = t[(i + 1) % 3];
      if (isBehind(cut, a) == isBehind(cut, b)) continue;
      const double from = component(a, cut.axis), to = component(b, cut.axis);
      ends.push_back(a + (cut.value - from) / (to - from) * (b - a));
    }
    if (ends.size() == 2) line.push_back({ends[0], ends[1]});
  }
  return line;
}

// ---- the faces

/// A face of a tetrahedron that is shown.
struct Facet {
  std::array<int, 3> nodes;
  int tet;
  int label;  // as Mesh::faceLabel, 0 where the mesh has no labels
  bool boundary;
  int colour = 0, tone = 0;  // entry of the legend; shade, 0 the darkest
};

/// The faces between tetrahedra behind the cut and the rest; with `sheets` also all faces of
/// inserted surfaces before it.
std::vector<Facet> facetsBehind(const Mesh& M, const Cut& cut, bool sheets, int& shown) {
  std::vector<char> behind(M.tets.size());
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    Vec3 sum;
    for (int n : M.tets[E]) sum += M.x[n];
    behind[E] = isBehind(cut, .25 * sum);
  }
  shown = static_cast<int>(std::count(behind.begin(), behind.end(), 1));
  const std::vector<std::array<int, 4>> neighbour = faceNeighbours(M);
  std::vector<Facet> facets;
  for (int E = 0; E < static_cast<int>(M.tets.size()); ++E)
    for (int i = 0; i < 4; ++i) {
      const int other = neighbour[E][i], label = M.faceLabel.empty() ? 0 : M.faceLabel[E][i];
      const bool otherBehind = other >= 0 && behind[other];
      const bool sheet = sheets && label > 0 && !behind[E] && !otherBehind && other < E;
      if (!sheet && (!behind[E] || otherBehind)) continue;
      const std::array<int, 4>& z = M.tets[E];
      facets.push_back(
          {{z[(i + 1) % 4], z[(i + 2) % 4], z[(i + 3) % 4]}, E, label, other < 0 && label <= 0});
    }
  return facets;
}

// ---- colours

struct Rgb {
  double r, g, b;
};

std::string hex(Rgb c, double light = 1) {
  auto byte = [&](double v) { return std::clamp(static_cast<int>(light * v + .5), 0, 255); };
  return format("#%02x%02x%02x", byte(c.r), byte(c.g), byte(c.b));
}

/// From dark blue (0) to pale yellow (1), after ColorBrewer's YlGnBu: even steps in lightness, safe
/// for colour-blind readers.
Rgb rampColour(double t) {
  constexpr Rgb stops[] = {
      {8, 29, 88}, {36, 70, 156}, {29, 145, 192}, {127, 205, 187}, {255, 255, 217}};
  const double at = 4 * std::clamp(t, 0., 1.);
  const int i = std::min(3, static_cast<int>(at));
  const Rgb a = stops[i], b = stops[i + 1];
  const double w = at - i;
  return {a.r + w * (b.r - a.r), a.g + w * (b.g - a.g), a.b + w * (b.b - a.b)};
}

/// Okabe and Ito's colours, told apart by colour-blind readers; from the eighth on again.
Rgb sheetColour(int k) {
  constexpr Rgb colours[] = {{213, 94, 0},  {0, 114, 178},  {0, 158, 115}, {204, 121, 167},
                             {230, 159, 0}, {86, 180, 233}, {240, 228, 66}};
  return colours[(k - 1) % 7];
}

constexpr Rgb sheetFill{244, 165, 100}, sheetLine{190, 60, 0};  // where all have one colour
constexpr Rgb invertedFill{208, 28, 139};
constexpr int qualityClasses = 20;  // as in QualityStatistics::histogram

/// What the colours mean.
struct Legend {
  struct Entry {
    Rgb colour;
    std::string text;
  };
  std::string title;
  std::vector<Entry> entries;
  int bar = 0;  // so many entries first are the classes of q, drawn as a colour bar
};

int inserted(const Mesh& M) {
  int highest = 0;
  for (const std::array<int, 4>& labels : M.faceLabel)
    for (int label : labels) highest = std::max(highest, label);
  return highest;
}

int qualityClass(double q) {
  return std::clamp(static_cast<int>(q * qualityClasses), 0, qualityClasses - 1);
}

Rgb qualityColour(int c) { return rampColour((c + .5) / qualityClasses); }

Legend colourByQuality(const Mesh& M, std::vector<Facet>& facets, bool line) {
  Legend legend{"quality q", {}, qualityClasses};
  for (int c = 0; c < qualityClasses; ++c) legend.entries.push_back({qualityColour(c), ""});
  legend.entries.push_back({invertedFill, "inverted"});
  if (line || inserted(M) > 0) legend.entries.push_back({sheetFill, "inserted surface"});
  const std::vector<double> q = qualities(M);
  for (Facet& f : facets)
    f.colour = f.label > 0     ? qualityClasses + 1
               : q[f.tet] <= 0 ? qualityClasses
                               : qualityClass(q[f.tet]);
  return legend;
}

Legend colourByLevel(const Mesh& M, std::vector<Facet>& facets, bool line) {
  if (M.level.empty())
    fail(
        "picture: the mesh has no levels of bisection; only a .vtk file of meccano has, use "
        "--colour quality");
  const auto [low, high] = std::minmax_element(M.level.begin(), M.level.end());
  const int lowest = *low, levels = *high - lowest + 1;
  std::vector<int> count(levels, 0);
  for (int level : M.level) ++count[level - lowest];
  Legend legend{"level (tetrahedra)", {}, 0};
  for (int l = 0; l < levels; ++l)
    legend.entries.push_back(
        {rampColour(1 - (l + .5) / levels), format("%d (%d)", lowest + l, count[l])});
  if (line || inserted(M) > 0) legend.entries.push_back({sheetFill, "inserted surface"});
  for (Facet& f : facets) f.colour = f.label > 0 ? levels : M.level[f.tet] - lowest;
  return legend;
}

Legend colourBySurface(const Mesh& M, std::vector<Facet>& facets) {
  const int count = inserted(M);
  if (count == 0)
    fail("picture: no surface is inserted in the mesh; use --colour quality or --colour level");
  Legend legend{"surface", {{{250, 250, 246}, "cut"}, {{214, 224, 234}, "boundary"}}, 0};
  for (int k = 1; k <= count; ++k) {
    const bool named = k <= static_cast<int>(M.surfaces.size());
    legend.entries.push_back(
        {sheetColour(k), format("%d ", k) + (named ? M.surfaces[k - 1].name : std::string())});
  }
  for (Facet& f : facets) f.colour = f.label > 0 ? f.label + 1 : f.boundary ? 1 : 0;
  return legend;
}

Legend colourFacets(const Mesh& M, const PictureOptions& o, std::vector<Facet>& facets) {
  const bool line = !o.line.empty();
  if (o.colour == Colour::surface) return colourBySurface(M, facets);
  if (o.colour == Colour::level) return colourByLevel(M, facets, line);
  return colourByQuality(M, facets, line);
}

// ---- projection and visibility

/// Parallel projection: pixels to the right, pixels downwards, depth away from the eye.
struct View {
  Vec3 origin, right, down, away;
  Vec3 operator()(Vec3 x) const {
    const Vec3 d = x - origin;
    return {dot(right, d), dot(down, d), dot(away, d)};
  }
};

constexpr double drawnWidth = 560, drawnHeight = 500;  // pixels, at most, of what is behind the cut

/// The eye before the cut, a little aside and above; z is upwards.
View viewOf(const Cut& cut) {
  constexpr Vec3 towardsEye[3] = {{1, .4, .45}, {.4, -1, .45}, {.32, -.6, 1}};
  const Vec3 away = (-1 / norm(towardsEye[cut.axis])) * towardsEye[cut.axis];
  Vec3 right = cross(away, {0, 0, 1});
  right = (1 / norm(right)) * right;
  return {{0, 0, 0}, right, cross(away, right), away};
}

/// The part of the box behind the cut, as it is seen.
Box seenBox(const View& view, Box box, const Cut& cut) {
  (cut.axis == 0 ? box.high.x : cut.axis == 1 ? box.low.y : box.high.z) = cut.value;
  const Vec3 first = view(box.low);
  Box seen{first, first};
  for (int i = 1; i < 8; ++i)
    seen.add(view({i & 1 ? box.high.x : box.low.x, i & 2 ? box.high.y : box.low.y,
                   i & 4 ? box.high.z : box.low.z}));
  return seen;
}

View scaledView(const Cut& cut, const Box& box) {
  View view = viewOf(cut);
  view.origin = box.low;
  const Box seen = seenBox(view, box, cut);
  const Vec3 size = seen.high - seen.low;
  const double scale = std::min(drawnWidth / size.x, drawnHeight / size.y);
  for (Vec3* v : {&view.right, &view.down, &view.away}) *v = scale * *v;
  return view;
}

/// Light from the upper left behind the eye; the tones are few, so that faces can share them.
constexpr int tones = 6;
constexpr double darkest = .74;

double lightOf(int tone) { return darkest + (1 - darkest) * tone / (tones - 1); }

int toneOf(const Triangle3& seen) {
  constexpr Vec3 light{-.22, -.38, -.9};  // to the right, down, away
  const Vec3 n = cross(seen[1] - seen[0], seen[2] - seen[0]);
  const double length = norm(n);
  if (length == 0) return tones - 1;
  return std::min(tones - 1, static_cast<int>(tones * std::abs(dot(n, light)) / length));
}

/// Calls at(sample, depth) for the samples (pixel centres) inside a triangle.
template <class At>
void forEachSample(const Triangle3& p, int width, int height, At at) {
  const Vec2 a{p[0].x, p[0].y}, b{p[1].x, p[1].y}, c{p[2].x, p[2].y};
  const double area = cross(b - a, c - a);
  if (area == 0) return;
  auto bounds = [](double u, double v, double w, int size) {
    return std::pair<int, int>{std::max(0, static_cast<int>(std::min({u, v, w}) - .5)),
                               std::min(size - 1, static_cast<int>(std::max({u, v, w}) + .5))};
  };
  const auto [x0, x1] = bounds(a.x, b.x, c.x, width);
  const auto [y0, y1] = bounds(a.y, b.y, c.y, height);
  for (int y = y0; y <= y1; ++y)
    for (int x = x0; x <= x1; ++x) {
      const Vec2 s{x + .5, y + .5};
      const double u = cross(b - s, c - s) / area, v = cross(c - s, a - s) / area, w = 1 - u - v;
      if (u >= 0 && v >= 0 && w >= 0) at(y * width + x, u * p[0].z + v * p[1].z + w * p[2].z);
    }
}

/// The nearest facet at each sample, -1 none.
struct ItemBuffer {
  int width, height;
  std::vector<int> item;
};

ItemBuffer itemBuffer(const std::vector<Triangle3>& seen, int width, int height) {
  ItemBuffer B{width, height, std::vector<int>(std::size_t(width) * height, -1)};
  std::vector<double> depth(B.item.size(), 0);
  for (std::size_t f = 0; f < seen.size(); ++f)
    forEachSample(seen[f], width, height, [&](int s, double d) {
      if (B.item[s] >= 0 && depth[s] <= d) return;
      B.item[s] = static_cast<int>(f);
      depth[s] = d;
    });
  return B;
}

/// Facets in layers, to be painted one after the other: where two overlap at a sample, the one seen
/// there is in a later layer. -1: seen nowhere. Cycles are cut at the facet farthest away.
std::vector<int> paintingLayers(const std::vector<Triangle3>& seen, const ItemBuffer& B) {
  const int n = static_cast<int>(seen.size());
  std::vector<int> layer(n, -1);
  for (int f : B.item)
    if (f >= 0) layer[f] = 0;
  std::vector<std::pair<int, int>> before;  // first is to be painted before second
  for (int f = 0; f < n; ++f)
    if (layer[f] == 0)
      forEachSample(seen[f], B.width, B.height, [&](int s, double) {
        if (B.item[s] != f) before.push_back({f, B.item[s]});
      });
  std::sort(before.begin(), before.end());
  before.erase(std::unique(before.begin(), before.end()), before.end());
  std::vector<int> waits(n, 0), byDepth, ready;
  for (const auto& [first, second] : before) ++waits[second];
  for (int f = 0; f < n; ++f)
    if (layer[f] == 0) byDepth.push_back(f);
  auto depth = [&](int f) { return seen[f][0].z + seen[f][1].z + seen[f][2].z; };
  std::stable_sort(byDepth.begin(), byDepth.end(),
                   [&](int f, int g) { return depth(f) > depth(g); });
  std::vector<char> done(n, 0);
  auto finish = [&](int f) {
    done[f] = 1;
    for (auto p = std::lower_bound(before.begin(), before.end(), std::pair<int, int>{f, -1});
         p != before.end() && p->first == f; ++p) {
      layer[p->second] = std::max(layer[p->second], layer[f] + 1);
      if (--waits[p->second] == 0) ready.push_back(p->second);
    }
  };
  for (int start : byDepth)
    if (waits[start] == 0) ready.push_back(start);
  for (std::size_t next = 0, forced = 0; next < ready.size() || forced < byDepth.size();) {
    const int f = next < ready.size() ? ready[next++] : byDepth[forced++];
    if (!done[f]) finish(f);
  }
  return layer;
}

// ---- SVG

std::string escaped(const std::string& text, std::size_t most) {
  std::string out;
  for (char c : text.substr(0, most)) {
    if (c == '&')
      out += "&amp;";
    else if (c == '<')
      out += "&lt;";
    else if (c == '>')
      out += "&gt;";
    else if (c == '"')
      out += "&quot;";
    else
      out += static_cast<unsigned char>(c) < 32 || static_cast<unsigned char>(c) > 126 ? '?' : c;
  }
  return text.size() > most ? out + "..." : out;
}

int tenths(double pixels) { return static_cast<int>(std::lround(10 * pixels)); }

/// "a b", or "a-b": as short as a path may be.
void putPair(Text& out, int a, int b) {
  out << a;
  if (b >= 0) out << " ";
  out << b;
}

void putTriangle(Text& out, const Triangle3& t) {
  std::array<int, 6> p;
  for (int i = 0; i < 3; ++i) {
    p[2 * i] = tenths(t[i].x);
    p[2 * i + 1] = tenths(t[i].y);
  }
  out << "M";
  putPair(out, p[0], p[1]);
  out << "l";
  putPair(out, p[2] - p[0], p[3] - p[1]);
  if (p[4] >= p[2]) out << " ";
  putPair(out, p[4] - p[2], p[5] - p[3]);
  out << "z";
}

void putSegment(Text& out, Vec3 a, Vec3 b) {
  out << "M";
  putPair(out, tenths(a.x), tenths(a.y));
  out << "L";
  putPair(out, tenths(b.x), tenths(b.y));
}

void putText(Text& out, double x, double y, const std::string& text, const char* more = "") {
  out << format("<text x=\"%.1f\" y=\"%.1f\"%s>", x, y, more) << text << "</text>\n";
}

void putRectangle(Text& out, double x, double y, double w, double h, const std::string& fill,
                  const char* more = "") {
  out << format("<rect x=\"%.1f\" y=\"%.1f\" width=\"%.1f\" height=\"%.1f\" fill=\"%s\"%s/>\n", x,
                y, w, h, fill.c_str(), more);
}

void putPage(Text& out, double width, double height, const std::string& title) {
  out << format(
      "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"%.0f\" height=\"%.0f\" viewBox=\"0 0 %.0f "
      "%.0f\" font-family=\"Helvetica,Arial,sans-serif\" font-size=\"13\" fill=\"#222\">\n",
      width, height, width, height);
  out << "<title>" << title << "</title>\n";
  putRectangle(out, 0, 0, width, height, "#fff");
}

/// A bold edge: of an inserted surface where the picture shows its side, or its rim.
struct BoldEdge {
  int a, b, label, layer;
};

std::vector<BoldEdge> boldEdges(const Mesh& M, const std::vector<Facet>& facets,
                                const std::vector<int>& layer) {
  std::map<std::pair<int, int>, int> onSheet;  // edge, label
  for (std::size_t E = 0; E < M.faceLabel.size(); ++E)
    for (int i = 0; i < 4; ++i)
      for (int j = 1; M.faceLabel[E][i] > 0 && j < 4; ++j) {
        const int a = M.tets[E][(i + j) % 4], b = M.tets[E][(i + j % 3 + 1) % 4];
        onSheet[std::minmax(a, b)] = M.faceLabel[E][i];
      }
  struct Seen {
    int sheets = 0, others = 0, layer = -1;
  };
  std::map<std::pair<int, int>, Seen> seen;
  for (std::size_t f = 0; f < facets.size(); ++f)
    for (int i = 0; i < 3; ++i) {
      const std::pair<int, int> edge =
          std::minmax(facets[f].nodes[i], facets[f].nodes[(i + 1) % 3]);
      if (!onSheet.count(edge)) continue;
      Seen& s = seen[edge];
      ++(facets[f].label > 0 ? s.sheets : s.others);
      s.layer = std::max(s.layer, layer[f]);
    }
  std::vector<BoldEdge> edges;
  for (const auto& [edge, s] : seen)
    if (s.layer >= 0 && (s.others > 0 || s.sheets == 1))
      edges.push_back({edge.first, edge.second, onSheet[edge], s.layer});
  return edges;
}

/// What is drawn of a mesh, in pixels.
struct Drawing {
  std::vector<Facet> facets;
  std::vector<Triangle3> seen;  // [facets]
  std::vector<Vec3> nodes;      // as seen
  double width = 0, height = 0;
  Vec3 corner;             // of the frame in the view: what nodes and seen are relative to
  std::vector<int> layer;  // [facets], -1: not seen
  std::vector<BoldEdge> bold;
  Legend legend;
  int shown = 0, visible = 0;  // tetrahedra, facets
  std::string reduced;         // what was left out; "" nothing
};

/// Pixels right and down from the upper left corner of all that is drawn.
void place(Drawing& D, const Mesh& M, const Cut& cut) {
  const Box box = boxOf(M.x);
  const View view = scaledView(cut, box);
  Box frame = seenBox(view, box, cut);
  for (Vec3 x : M.x) D.nodes.push_back(view(x));
  for (const Facet& f : D.facets)
    for (int n : f.nodes) frame.add(D.nodes[n]);
  for (Vec3& p : D.nodes) p = p - frame.low;
  for (Facet& f : D.facets) {
    D.seen.push_back({D.nodes[f.nodes[0]], D.nodes[f.nodes[1]], D.nodes[f.nodes[2]]});
    f.tone = toneOf(D.seen.back());
  }
  D.corner = frame.low;
  D.width = frame.high.x - frame.low.x;
  D.height = frame.high.y - frame.low.y;
}

/// Facets that share layer, colour and tone share a path.
std::map<std::array<int, 3>, std::vector<int>> pathsOf(const Drawing& D) {
  std::map<std::array<int, 3>, std::vector<int>> paths;
  for (std::size_t f = 0; f < D.facets.size(); ++f)
    if (D.layer[f] >= 0)
      paths[{D.layer[f], D.facets[f].colour, D.facets[f].tone}].push_back(static_cast<int>(f));
  return paths;
}

Rgb lineColour(const Drawing& D, Colour colour, int label) {
  if (colour != Colour::surface) return sheetLine;
  const Rgb c = D.legend.entries[label + 1].colour;
  return {.55 * c.r, .55 * c.g, .55 * c.b};
}

void putBoldEdges(Text& out, const Drawing& D, Colour colour, int layer) {
  std::map<int, std::vector<BoldEdge>> ofLabel;
  for (const BoldEdge& e : D.bold)
    if (e.layer == layer || layer < 0) ofLabel[e.label].push_back(e);
  for (const auto& [label, edges] : ofLabel) {
    out << "<path class=\"b\" stroke=\"" << hex(lineColour(D, colour, label)) << "\" d=\"";
    for (const BoldEdge& e : edges) putSegment(out, D.nodes[e.a], D.nodes[e.b]);
    out << "\"/>\n";
  }
}

constexpr const char* boldStyle =
    "<style>.b{fill:none;stroke-opacity:1;stroke-width:24;stroke-linecap:round;stroke-linejoin:"
    "round}</style>\n";

/// The seen facets layer by layer, each with the bold edges in it. Without thin edges each facet is
/// stroked in its own colour, which closes the seams.
void putFacets(Text& out, const Drawing& D, Colour colour, bool edges) {
  out << "<g transform=\"scale(.1)\" stroke-linejoin=\"round\" "
      << (edges ? "stroke=\"#223\" stroke-opacity=\".55\" stroke-width=\"4\">\n"
                : "stroke-width=\"8\">\n");
  int layer = 0;
  for (const auto& [key, facets] : pathsOf(D)) {
    for (; layer < key[0]; ++layer) putBoldEdges(out, D, colour, layer);
    const std::string fill = hex(D.legend.entries[key[1]].colour, lightOf(key[2]));
    out << "<path fill=\"" << fill << (edges ? "" : "\" stroke=\"" + fill) << "\" d=\"";
    for (int f : facets) putTriangle(out, D.seen[f]);
    out << "\"/>\n";
  }
  putBoldEdges(out, D, colour, layer);
  out << "</g>\n";
}

std::vector<Triangle3> scaled(const std::vector<Triangle3>& seen, double factor) {
  std::vector<Triangle3> all = seen;
  for (Triangle3& t : all)
    for (Vec3& p : t) p = factor * p;
  return all;
}

ItemBuffer sampled(const Drawing& D, double perPixel) {
  return itemBuffer(scaled(D.seen, perPixel), static_cast<int>(D.width * perPixel) + 1,
                    static_cast<int>(D.height * perPixel) + 1);
}

/// The colours at the centres of squares of this size, equal ones of a row as one line.
void putSquares(Text& out, const Drawing& D, Colour colour, double size) {
  const ItemBuffer B = sampled(D, 1 / size);
  std::map<std::pair<int, int>, std::vector<std::array<int, 3>>> runs;  // of colour, tone
  auto lookAt = [&](int x, int y) {
    const int f = x < B.width ? B.item[y * B.width + x] : -1;
    return f < 0 ? std::pair<int, int>{-1, 0}
                 : std::pair<int, int>{D.facets[f].colour, D.facets[f].tone};
  };
  for (int y = 0; y < B.height; ++y)
    for (int x = 0, start = 0; x < B.width; ++x) {
      if (lookAt(x + 1, y) == lookAt(x, y)) continue;
      if (lookAt(x, y).first >= 0) runs[lookAt(x, y)].push_back({start, y, x + 1 - start});
      start = x + 1;
    }
  out << format("<g transform=\"scale(%g) translate(0 .5)\" stroke-width=\"1.05\">\n", size);
  for (const auto& [look, list] : runs) {
    out << "<path stroke=\"" << hex(D.legend.entries[look.first].colour, lightOf(look.second))
        << "\" d=\"";
    for (const auto& [x, y, n] : list) out << "M" << x << " " << y << "h" << n;
    out << "\"/>\n";
  }
  out << "</g>\n<g transform=\"scale(.1)\">\n";
  putBoldEdges(out, D, colour, -1);
  out << "</g>\n";
}

/// The mesh itself, below maxBytes: with edges, without them, or as coloured squares.
void putMesh(Text& out, Drawing& D, Colour colour) {
  constexpr int withEdges = 9000, facetsAtMost = 13000;  // about 20 bytes each
  constexpr std::size_t maxBytes = 280000;
  if (D.visible <= facetsAtMost) {
    if (D.visible > withEdges) D.reduced = "too many for their edges to be drawn";
    putFacets(out, D, colour, D.visible <= withEdges);
    return;
  }
  std::string squares;
  for (double size : {1.5, 2., 2.5, 3., 4.}) {
    Text text;
    putSquares(text, D, colour, size);
    squares = text.take();
    D.reduced = format("drawn as squares of %g pixels", size);
    if (squares.size() < maxBytes) break;
  }
  out << squares;
}

void putBar(Text& out, const Legend& legend, double x, double y) {
  constexpr double step = 9, width = 18;
  for (int c = 0; c < legend.bar; ++c)
    putRectangle(out, x, y + step * (legend.bar - 1 - c), width, step + .3,
                 hex(legend.entries[c].colour));
  const double height = step * legend.bar;
  putRectangle(out, x, y, width, height, "none", " stroke=\"#444\" stroke-width=\".7\"");
  for (int i = 0; i <= 5; ++i) {
    const double at = y + height * (1 - i / 5.);
    out << format("<path d=\"M%.1f %.1fh5\" stroke=\"#444\" stroke-width=\".7\"/>\n", x + width,
                  at);
    putText(out, x + width + 9, at + 4.5, format("%g", i / 5.));
  }
}

/// The legend's lower end.
double putLegend(Text& out, const Legend& legend, double x, double y) {
  constexpr std::size_t most = 22;  // entries
  putText(out, x, y + 11, legend.title, " font-weight=\"bold\"");
  y += 26;
  if (legend.bar > 0) {
    putBar(out, legend, x, y);
    y += 9 * legend.bar + 18;
  }
  const std::size_t end = std::min(legend.entries.size(), legend.bar + most);
  for (std::size_t i = legend.bar; i < end; ++i, y += 20) {
    putRectangle(out, x, y, 18, 13, hex(legend.entries[i].colour),
                 " stroke=\"#444\" stroke-width=\".7\"");
    putText(out, x + 27, y + 11, escaped(legend.entries[i].text, 18));
  }
  if (end == legend.entries.size()) return y;
  putText(out, x + 27, y + 11,
          format("and %d more", static_cast<int>(legend.entries.size() - end)));
  return y + 20;
}

/// The axes' directions, as seen, around (x, y).
void putTriad(Text& out, const Cut& cut, double x, double y) {
  constexpr double length = 30;
  const View view = viewOf(cut);
  const Vec3 axes[3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  for (int i = 0; i < 3; ++i) {
    const Vec3 tip = length * view(axes[i]);
    const double reach = 1 + 9 / std::max(9., std::hypot(tip.x, tip.y));
    out << format("<path d=\"M%.1f %.1fl%.1f %.1f\" stroke=\"#222\" stroke-width=\"1.4\"/>\n", x, y,
                  tip.x, tip.y);
    putText(out, x + reach * tip.x, y + reach * tip.y + 4, std::string(1, axisNames[i]),
            " text-anchor=\"middle\" font-style=\"italic\"");
  }
}

std::vector<std::string> captionOf(const Mesh& M, const PictureOptions& o, const Drawing& D) {
  const QualityStatistics q = qualityStatistics(M);
  std::vector<std::string> lines{
      format("Behind %s: %d of %d tetrahedra, %d faces seen", nameOf(o.cut).c_str(), D.shown,
             q.tetrahedra, D.visible),
      format("q of all tetrahedra: min %.3f, mean %.3f, std dev %.3f; inverted %d", q.min, q.mean,
             q.stdDev, q.inverted)};
  if (!o.line.empty()) lines.push_back("Bold: where the surface will come");
  if (M.xi.empty()) lines.push_back("Ideal elements: regular tetrahedra");
  if (!D.reduced.empty()) lines.push_back("Faces are " + D.reduced);
  return lines;
}

void checkCut(const Mesh& M, const Cut& cut) {
  if (M.tets.empty()) fail("picture: the mesh has no tetrahedra; nothing can be drawn");
  const Box box = boxOf(M.x);
  const double low = component(box.low, cut.axis), high = component(box.high, cut.axis);
  if (!(cut.value > low && cut.value < high))
    fail("picture: the cut " + nameOf(cut) + " is not inside the mesh, which reaches from " +
         format("%.6g to %.6g", low, high) + "; choose a value between");
}

Drawing drawingOf(const Mesh& M, const PictureOptions& o) {
  constexpr double samplesPerPixel = 2;
  Drawing D;
  D.facets = facetsBehind(M, o.cut, o.colour == Colour::surface, D.shown);
  if (D.shown == 0)
    fail("picture: no tetrahedron has its centre behind " + nameOf(o.cut) + "; move the cut");
  D.legend = colourFacets(M, o, D.facets);
  place(D, M, o.cut);
  D.layer = paintingLayers(scaled(D.seen, samplesPerPixel), sampled(D, samplesPerPixel));
  D.bold = boldEdges(M, D.facets, D.layer);
  for (int layer : D.layer) D.visible += layer >= 0;
  return D;
}

/// Where the surface will come: on the cut plane, over all.
void putLine(Text& out, const Mesh& M, const PictureOptions& o, Vec3 corner) {
  const View view = scaledView(o.cut, boxOf(M.x));
  out << "<path transform=\"scale(.1)\" class=\"b\" stroke=\"" << hex(sheetLine) << "\" d=\"";
  for (const Segment& s : o.line) putSegment(out, view(s.a) - corner, view(s.b) - corner);
  out << "\"/>\n";
}

/// The picture as SVG, below 300 kB. Errors: InputError where the cut shows nothing, or the mesh
/// does not have what gives the colours.
std::string pictureText(const Mesh& M, const PictureOptions& o) {
  constexpr double margin = 24, gap = 30, legendWidth = 165, lineHeight = 19, triadSize = 96;
  checkCut(M, o.cut);
  Drawing D = drawingOf(M, o);
  Text mesh, side;
  putMesh(mesh, D, o.colour);
  if (!o.line.empty()) putLine(mesh, M, o, D.corner);
  const std::vector<std::string> caption = captionOf(M, o, D);
  const double meshWidth = std::max(D.width, 390.), x = margin + meshWidth + gap;
  const double legendEnd = putLegend(side, D.legend, x, margin + lineHeight) + triadSize;
  const double bottom = std::max(margin + lineHeight + 8 + D.height, legendEnd);
  putTriad(side, o.cut, x + 45, bottom - 40);
  Text out;
  const int lines = static_cast<int>(caption.size());
  putPage(out, x + legendWidth, bottom + gap + lineHeight * lines, escaped(o.title, 200));
  out << boldStyle;
  putText(out, margin, margin + 6, escaped(o.title, 50), " font-weight=\"bold\" font-size=\"15\"");
  const double top = margin + lineHeight + 8 + .5 * (bottom - margin - lineHeight - 8 - D.height);
  out << format("<g transform=\"translate(%.1f %.1f)\">\n", margin + .5 * (meshWidth - D.width),
                top)
      << mesh.take() << "</g>\n"
      << side.take();
  for (int i = 0; i < lines; ++i)
    putText(out, margin, bottom + gap - 4 + lineHeight * i, caption[i]);
  out << "</svg>\n";
  return out.take();
}

// ---- Figure 9

/// 1, 2 or 5 times a power of ten: at most five steps up to the value.
int roundStep(int value) {
  for (int ten = 1;; ten *= 10)
    for (int step : {1, 2, 5})
      if (value <= 5 * std::int64_t(step) * ten || ten >= 100000000) return step * ten;
}

void putHistogramAxes(Text& out, double x, double y, double width, double height, int highest) {
  const int step = roundStep(highest);
  for (int n = 0; n <= highest; n += step) {
    const double at = y + height * (1 - double(n) / highest);
    out << format("<path d=\"M%.1f %.1fh%.1f\" stroke=\"%s\" stroke-width=\".7\"/>\n", x, at, width,
                  n == 0 ? "#444" : "#ddd");
    putText(out, x - 8, at + 4.5, format("%d", n), " text-anchor=\"end\"");
  }
  for (int i = 0; i <= 10; ++i)
    putText(out, x + width * i / 10, y + height + 19, format("%g", i / 10.),
            " text-anchor=\"middle\"");
  putText(out, x + width / 2, y + height + 40, "quality q", " text-anchor=\"middle\"");
  putText(out, x - 60, y - 14, "tetrahedra");
}

/// Figure 9: how many tetrahedra have which quality, in 20 classes.
std::string histogramText(const QualityStatistics& q, const std::string& title, const char* ideal) {
  constexpr double x = 84, y = 84, width = 560, height = 280, margin = 24;
  const int highest = std::max(1, *std::max_element(q.histogram.begin(), q.histogram.end()));
  Text out;
  putPage(out, x + width + margin, y + height + 106, escaped(title, 200));
  putText(out, margin, margin + 6, escaped(title, 50), " font-weight=\"bold\" font-size=\"15\"");
  putHistogramAxes(out, x, y, width, height, highest);
  const double step = width / qualityClasses;
  auto bar = [&](int c, int n, const std::string& fill) {
    putRectangle(out, x + step * c + 1, y + height * (1 - double(n) / highest), step - 2,
                 height * n / highest, fill, " stroke=\"#223\" stroke-width=\".5\"");
  };
  for (int c = 0; c < qualityClasses; ++c) {
    const int n = q.histogram[c];
    if (n == 0) continue;
    bar(c, n, hex(qualityColour(c)));
    if (c == 0 && q.inverted > 0) bar(c, q.inverted, hex(invertedFill));
    putText(out, x + step * (c + .5), y + height * (1 - double(n) / highest) - 4, format("%d", n),
            " text-anchor=\"middle\" font-size=\"9\"");
  }
  putText(out, margin, y + height + 68,
          format("%d tetrahedra, inverted %d; ideal: %s", q.tetrahedra, q.inverted, ideal));
  putText(out, margin, y + height + 87,
          format("q: min %.3f, max %.3f, mean %.3f, std dev %.3f", q.min, q.max, q.mean, q.stdDev));
  out << "</svg>\n";
  return out.take();
}

// ==== Arguments =================================================================================

std::string counted(std::size_t n, const std::string& one) {
  return std::to_string(n) + ' ' + one + (n == 1 ? "" : "s");
}

/// Control characters, which a message may quote from a file, are for no terminal.
std::string printable(std::string text) {
  for (char& c : text)
    if (static_cast<unsigned char>(c) < ' ' || c == 127) c = '?';
  return text;
}

/// Wrong usage: exit status 2.
struct UsageError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

/// Standard output for results, standard error for progress and errors.
struct Streams {
  std::ostream& out;
  std::ostream& err;
  bool terminal;  // err is one: lines may be rewritten
};

struct Arguments {
  std::vector<std::string> operands;
  std::map<std::string, std::vector<std::string>> options;

  bool has(const char* name) const { return options.count(name) > 0; }
  template <class Number>
  Number number(const char* name, Number otherwise, std::size_t i = 0) const {
    const auto found = options.find(name);
    if (found == options.end()) return otherwise;
    Number value{};
    if (!parse(found->second[i], value))
      throw UsageError("'" + found->second[i] + "' is no " +
                       (std::is_same_v<Number, int> ? "integer up to 2147483647" : "number") +
                       " for " + name);
    if (!std::isfinite(double(value))) throw UsageError(std::string(name) + " must be finite");
    return value;
  }
  /// A length; refuses 0 and less.
  double length(const char* name, double otherwise) const {
    const double value = number(name, otherwise);
    if (has(name) && !(value > 0)) fail(name + (' ' + options.at(name)[0]) + " must be above 0");
    return value;
  }
  Vec3 vec3(const char* name, Vec3 otherwise) const {
    return {number(name, otherwise.x, 0), number(name, otherwise.y, 1),
            number(name, otherwise.z, 2)};
  }
  /// The mesh to write: a file of a known suffix, or a device; not what is read as something else
  /// than the mesh that is changed, as the operands from `kept` on.
  std::string output(std::size_t kept) const {
    const auto found = options.find("-o");
    if (found == options.end()) throw UsageError("the output is missing: -o OUT");
    const std::string& path = found->second[0];
    if (!isMeshSuffix(suffixOf(path)) && !isDevice(path))
      throw UsageError("'" + path + "' does not end in " + meshSuffixes +
                       ", the formats of the output");
    std::vector<std::string> read(operands.begin() + kept, operands.end());
    for (const char* name : {"--ideal", "--polycube"})
      if (has(name)) read.push_back(options.at(name)[0]);
    for (const std::string& input : read)
      if (std::error_code none; !isDevice(path) && fs::equivalent(path, input, none))
        throw UsageError("'" + path + "' would be read and overwritten; write the mesh elsewhere");
    return path;
  }
  /// The picture an option names: an .svg file, or a device; "" where the option is not given.
  std::string svg(const char* option) const {
    if (!has(option)) return "";
    const std::string& path = options.at(option)[0];
    if (fs::path(path).extension() != ".svg" && !isDevice(path))
      throw UsageError("'" + path + "' does not end in .svg, the format of a picture");
    return path;
  }
};

// ==== Progress and tables =======================================================================

/// Lines on standard error; while sweeping one that rewrites itself on a terminal.
class Progress {
 public:
  Progress(const Streams& io, bool quiet) : io_(io), quiet_(quiet) {}
  Progress(const Progress&) = delete;
  Progress& operator=(const Progress&) = delete;
  ~Progress() { endSweeps(); }
  void line(const std::string& text) {
    endSweeps();
    if (!quiet_) io_.err << printable(text) << std::endl;
  }
  /// For onSweep, which costs a pass over the mesh: none where nobody looks.
  std::function<void(const Sweep&)> sweeps() {
    if (quiet_ || !io_.terminal) return nullptr;
    return [this](const Sweep& s) { sweep(s); };
  }
  void sweep(const Sweep& s) {
    const char* pattern = "\r\033[Ksweep %d  inverted %d  min q %.4f  displacement %.2g";
    io_.err << format(pattern, s.number, s.inverted, s.minQ, s.disp) << std::flush;
    sweeping_ = true;
  }
  void warning(const std::string& text) {
    endSweeps();
    io_.err << "meccano: warning: " << printable(text) << std::endl;
  }

 private:
  void endSweeps() {
    if (sweeping_) io_.err << std::endl;
    sweeping_ = false;
  }
  const Streams& io_;
  bool quiet_, sweeping_ = false;
};

struct Column {
  const char* head;
  const QualityStatistics* q;
};

/// Table I: a column for each mesh.
std::string tableI(const std::vector<Column>& columns) {
  std::string text = format("%-12s", "Table I");
  for (const Column& c : columns) text += format("%14s", c.head);
  text += format("\n%-12s", "tetrahedra");
  for (const Column& c : columns) text += format("%14d", c.q->tetrahedra);
  text += format("\n%-12s", "inverted");
  for (const Column& c : columns) text += format("%14d", c.q->inverted);
  const std::pair<const char*, double QualityStatistics::*> rows[] = {
      {"min", &QualityStatistics::min},
      {"max", &QualityStatistics::max},
      {"mean", &QualityStatistics::mean},
      {"std dev", &QualityStatistics::stdDev}};
  for (const auto& [name, member] : rows) {
    text += format("\n%-12s", name);
    for (const Column& c : columns) text += format("%14.4f", c.q->*member);
  }
  return text + "\n";
}

std::string regularLine(const QualityStatistics& q) {
  return format(
      "against the regular tetrahedron: inverted %d, min %.4f, max %.4f, mean %.4f, "
      "std dev %.4f\n",
      q.inverted, q.min, q.max, q.mean, q.stdDev);
}

/// A file's name without its folder.
std::string nameOf(const std::string& path) { return fs::path(path).filename().string(); }

std::string sizeOf(const Mesh& M) {
  return std::to_string(M.x.size()) + " nodes, " + std::to_string(M.tets.size()) + " tetrahedra";
}

// ==== Commands ==================================================================================

void runBox(const Arguments& a, const Streams& io) {
  const std::string path = a.output(0);
  const std::array<int, 3> cells{a.number("--cells", 1, 0), a.number("--cells", 1, 1),
                                 a.number("--cells", 1, 2)};
  const Vec3 origin = a.vec3("--origin", {0, 0, 0}), size = a.vec3("--size", {1, 1, 1});
  checkWritable(path);
  const Mesh M = boxMesh(origin, size, cells);
  writeFiles({{path, meshText(path, M)}});
  io.err << path << ": " << sizeOf(M) << std::endl;
}

/// Table I of a mesh from Algorithm 1, and what it promises.
void printMesher(const MesherReport& r, const Streams& io) {
  io.out
      << tableI({{"refined", &r.refined}, {"untangled", &r.untangled}, {"smoothed", &r.smoothed}})
      << regularLine(r.regular)
      << format(
             "eps %.6g: distance of the mesh's boundary %.6g, of the solid's %.6g; %d bisections "
             "at most, %d passes, %d rounds of sliding\n",
             r.eps, r.distance.toSolid, r.distance.toMesh, r.depth, r.passes, r.rounds);
}

MesherOptions mesherOptions(const Arguments& a, Progress& progress) {
  MesherOptions o;
  o.eps = a.length("--eps", o.eps);
  o.maxTets = a.number("--max-tets", o.maxTets);
  o.fixedBoundary = a.has("--fixed-boundary");
  o.optimize.power = a.number("--power", o.optimize.power);
  o.optimize.threads = a.number("--threads", 0);
  checkOptions(o.optimize, 0);
  o.onProgress = [&progress](const std::string& line) { progress.line(line); };
  o.optimize.onSweep = progress.sweeps();
  return o;
}

/// Writes a mesh of Algorithm 1 and prints its report.
void finishMesher(const std::string& path, const Mesh& M, const MesherReport& r, Progress& progress,
                  const Streams& io) {
  printMesher(r, io);
  if (!io.out.flush()) fail("standard output: the results cannot be written; nothing was written");
  writeFiles({{path, vtkText(M)}});
  for (const std::string& w : r.warnings) progress.warning(w);
  progress.line(path + ": " + sizeOf(M));
}

void runTerrain(const Arguments& a, const Streams& io) {
  const std::string path = a.output(0);
  if (!a.has("--top")) throw UsageError("the height of the top is missing: --top Z");
  Progress progress(io, a.has("--quiet"));
  MesherOptions options = mesherOptions(a, progress);
  checkWritable(path);
  Terrain T = readTerrain(a.operands[0]);
  T.top = a.number("--top", 0.);
  if (a.has("--cells"))
    for (std::size_t i = 0; i < 3; ++i) {
      T.cells[i] = a.number("--cells", 1, i);
      if (T.cells[i] < 1) fail("--cells must be 1 or more");
    }
  const std::array<int, 3> cells = terrainCells(T);
  if (!a.has("--eps")) options.eps = terrainEps(T);
  progress.line("terrain " + a.operands[0] + ": " + std::to_string(T.nx) + " x " +
                std::to_string(T.ny) + " heights, " + std::to_string(cells[0]) + " x " +
                std::to_string(cells[1]) + " x " + std::to_string(cells[2]) + " cells, eps " +
                format("%.6g", options.eps));
  Mesh M;
  const MesherReport report = meccanoMesher(M, T, options);
  finishMesher(path, M, report, progress, io);
}

void runSolid(const Arguments& a, const Streams& io) {
  const std::string path = a.output(0);
  if (!a.has("--eps")) throw UsageError("the precision is missing: --eps E");
  Progress progress(io, a.has("--quiet"));
  MesherOptions options = mesherOptions(a, progress);
  checkWritable(path);
  std::vector<std::string> warnings;
  const std::vector<TriangleSurface> all = readSurfaces(a.operands[0], warnings);
  for (const std::string& warning : warnings) progress.warning(warning);
  if (all.size() != 1)
    fail(a.operands[0] + ": holds " + std::to_string(all.size()) +
         " surfaces, and the boundary of one solid is needed; keep one");
  const TriangleSurface& S = all[0];
  if (a.has("--polycube")) {
    const std::string& file = a.options.at("--polycube")[0];
    options.meccano = parsePolycube(file, readFile(file));
  }
  progress.line("solid " + a.operands[0] + ": " + counted(S.points.size(), "point") + ", " +
                counted(S.triangles.size(), "triangle"));
  Mesh M;
  const MesherReport report = meccanoMesher(M, S, options);
  finishMesher(path, M, report, progress, io);
}

/// What insertion needs of a mesh that was read.
void checkInsertable(const std::string& path, const Mesh& M) {
  if (M.xi.empty())
    fail(path +
         ": the mesh has no computational coordinates, and bisection needs them; only .vtk keeps "
         "the meccano: start from `meccano box` or a .vtk file that meccano wrote");
  int highest = 0;
  for (const std::array<int, 4>& labels : M.faceLabel)
    for (int label : labels) highest = std::max(highest, label);
  if (highest > static_cast<int>(M.surfaces.size()))
    fail(path + ": surface " + std::to_string(highest) +
         " is marked in it without its geometry, "
         "as in the stages of an insertion; insert into a finished mesh");
}

/// Table I: the mesh before the first surface and after the last, refined and projected for the
/// last as in Figure 12; then a line for each surface as it is at the end.
void printInsertion(const std::vector<InsertReport>& reports, const Mesh& M, const Streams& io) {
  const InsertReport& last = reports.back();
  io.out << tableI({{"original", &reports.front().original},
                    {"refined", &last.refined},
                    {"projected", &last.projected},
                    {"smoothed", &last.smoothed}})
         << regularLine(last.regular);
  for (const InsertReport& r : reports)
    io.out << format(
        "surface %d (%.60s), l_c %.6g: %d nodes, %d triangles, largest node distance "
        "%.3g, Hausdorff distance %.3g, tangential shift %.3g\n",
        r.surface, M.surfaces[r.surface - 1].name.c_str(), r.lc, r.nodes, r.triangles,
        r.maxNodeDistance, r.hausdorff, r.tangentialShift);
}

InsertOptions insertOptions(const Arguments& a) {
  InsertOptions o = a.has("--paper") ? InsertOptions::paper() : InsertOptions{};
  if (a.has("--lc") && a.has("--tolerance"))
    throw UsageError("--lc and --tolerance both choose the size; give one of them, or none");
  o.lc = a.length("--lc", o.lc);
  o.tolerance = a.length("--tolerance", o.tolerance);
  o.maxTets = a.number("--max-tets", o.maxTets);
  o.optimize.power = a.number("--power", o.optimize.power);
  o.optimize.threads = a.number("--threads", 0);
  checkOptions(o.optimize, 0);
  return o;
}

/// PREFIX-name; in a folder, where PREFIX ends in /, the name alone.
std::string stageFile(const std::string& prefix, char mark, const std::string& name) {
  return prefix.back() == '/' ? prefix + name : prefix + mark + name;
}

/// Whether a file of --stages PREFIX may have this path: PREFIX-original.vtk, PREFIX-2-refined.vtk.
bool isStage(const std::string& prefix, const std::string& path) {
  const auto placeOf = [](const std::string& file) {
    std::error_code none;
    const fs::path whole = fs::absolute(file, none);
    return (fs::weakly_canonical(whole.parent_path(), none) / whole.filename()).string();
  };
  const std::string last = "original.vtk", first = placeOf(stageFile(prefix, '-', last));
  const std::size_t begin = first.size() - last.size();
  const std::string place = placeOf(path);
  if (place.compare(0, begin, first, 0, begin) != 0) return false;
  std::string name = place.substr(begin);
  const std::size_t digits = name.find_first_not_of("0123456789");
  if (digits > 0 && digits != std::string::npos && name[digits] == '-') name.erase(0, digits + 1);
  return name == last || name == "refined.vtk" || name == "projected.vtk" || name == "smoothed.vtk";
}

/// The files of --stages PREFIX. Stages come once for each way of inserting that is tried; those of
/// the way that was taken are written. With several surfaces their number follows the prefix:
/// PREFIX-2-projected.vtk.
struct Stages {
  std::string prefix;    // empty: none are kept
  std::string pictures;  // the same for --pictures PREFIX
  bool several = false;
  Cut cut = {};                    // of all pictures
  std::vector<Segment> line = {};  // where the surfaces meet it
  int surface = 0, way = 0;        // under way
  struct Kept {
    int surface, way;  // 0: whichever
    Output output;
  };
  std::vector<Kept> kept = {};

  void keep(const std::string& name, const Mesh& M, int ofSurface, int ofWay) {
    if (!prefix.empty())
      kept.push_back({ofSurface, ofWay, {stageFile(prefix, '-', name + ".vtk"), vtkText(M)}});
    if (pictures.empty()) return;
    PictureOptions o{cut, Colour::quality, name};
    if (ofSurface == 0) o.line = line;
    kept.push_back(
        {ofSurface, ofWay, {stageFile(pictures, '_', name + ".svg"), pictureText(M, o)}});
  }
  void cutAcross(const std::vector<TriangleSurface>& surfaces, const Mesh& M) {
    std::vector<Triangle3> triangles;
    for (const TriangleSurface& S : surfaces) {
      const std::vector<Triangle3> more = trianglesOf(S);
      triangles.insert(triangles.end(), more.begin(), more.end());
    }
    cut = defaultCut(triangles, M);
    line = sectionOf(triangles, cut);
  }
  void see(const std::string& stage, const Mesh& M) {
    const int k = static_cast<int>(M.surfaces.size());
    if (stage == "approximated" && k + 1 != surface) begin(k + 1);
    way += stage == "extracted";
    const std::string number = several ? std::to_string(surface) + '-' : "";
    if (stage == "surfaceHealed") keep(number + "refined", M, surface, way);  // Figure 8b, 11a
    if (stage == "projected") keep(number + "projected", M, surface, way);
    if (stage == "smoothed") keep(number + "smoothed", M, surface, 0);
  }
  /// Surface k, for the first time or again: what was seen of it and of later ones is void.
  void begin(int k) {
    surface = k;
    way = 0;
    kept.erase(
        std::remove_if(kept.begin(), kept.end(), [&](const Kept& o) { return o.surface >= k; }),
        kept.end());
  }
  void take(const std::vector<InsertReport>& reports, std::vector<Output>& outputs) const {
    for (const Kept& o : kept)
      for (const InsertReport& r : reports)
        if (o.surface == 0 ? &r == &reports[0]
                           : o.surface == r.surface && (o.way == 0 || o.way == r.way))
          outputs.push_back(o.output);
  }
};

/// Several files, and several surfaces in a file, become one list.
std::vector<TriangleSurface> readSurfaces(const Arguments& a, Progress& progress) {
  std::vector<TriangleSurface> surfaces;
  std::vector<std::string> notes;
  for (std::size_t i = 1; i < a.operands.size(); ++i)
    for (const TriangleSurface& S : readSurfaces(a.operands[i], notes)) {
      surfaces.push_back(S);
      progress.line("surface " + a.operands[i] + ": " + S.name + ", " +
                    counted(S.points.size(), "point") + ", " +
                    counted(S.triangles.size(), "triangle"));
    }
  for (const std::string& note : notes) progress.warning(note);
  return surfaces;
}

void runInsert(const Arguments& a, const Streams& io) {
  const std::string path = a.output(1);
  InsertOptions options = insertOptions(a);
  const std::string prefix = a.has("--stages") ? a.options.at("--stages")[0] : "";
  if (!prefix.empty() && isStage(prefix, path))
    throw UsageError("the mesh and a stage would both be written to " + path);
  for (const std::string& input : a.operands)
    if (!prefix.empty() && isStage(prefix, input))
      throw UsageError("'" + input + "' would be read and overwritten; choose another --stages");
  checkWritable(path);
  if (!prefix.empty()) checkWritable(stageFile(prefix, '-', "original.vtk"));
  const std::string pictures = a.has("--pictures") ? a.options.at("--pictures")[0] : "";
  if (!pictures.empty()) checkWritable(stageFile(pictures, '_', "original.svg"));
  Mesh M = readMesh(a.operands[0]);
  checkInsertable(a.operands[0], M);
  Progress progress(io, a.has("--quiet"));
  progress.line("mesh " + a.operands[0] + ": " + sizeOf(M));
  const std::vector<TriangleSurface> surfaces = readSurfaces(a, progress);
  Stages stages{prefix, pictures, surfaces.size() > 1};
  if (!pictures.empty()) stages.cutAcross(surfaces, M);
  stages.keep("original", M, 0, 0);
  options.onStage = [&](const char* stage, const Mesh& mesh) { stages.see(stage, mesh); };
  options.onProgress = [&](const std::string& line) { progress.line(line); };
  options.optimize.onSweep = progress.sweeps();
  const std::vector<InsertReport> reports = insertSurfaces(M, surfaces, options);
  std::vector<Output> outputs{{path, meshText(path, M)}};
  stages.take(reports, outputs);
  printInsertion(reports, M, io);
  if (!io.out.flush()) fail("standard output: the results cannot be written; nothing was written");
  writeFiles(outputs);
  for (const InsertReport& report : reports)
    for (const std::string& w : report.warnings)
      progress.warning((reports.size() > 1 ? M.surfaces[report.surface - 1].name + ": " : "") + w);
  progress.line(path + ": " + sizeOf(M));
}

OptimizeOptions optimizeOptions(const Arguments& a) {
  OptimizeOptions o = a.has("--paper") ? OptimizeOptions::paper() : OptimizeOptions{};
  o.maxDisp = a.number("--max-disp", o.maxDisp);
  o.maxSweeps = a.number("--max-sweeps", o.maxSweeps);
  o.power = a.number("--power", o.power);
  o.threads = a.number("--threads", 0);
  checkOptions(o, 0);
  return o;
}

/// The mesh of --ideal: its nodes make the ideal elements of M, so its tetrahedra must be M's.
std::vector<Vec3> idealNodes(const std::string& path, const Mesh& M) {
  if (!M.xi.empty())
    fail("--ideal " + path +
         ": the mesh has computational elements, which are its ideal ones; --ideal is for meshes "
         "without them (`meccano convert` it to .mesh before)");
  const Mesh rest = readMesh(path);
  if (rest.x.size() != M.x.size() || rest.tets.size() != M.tets.size())
    fail(path + ": has " + sizeOf(rest) + ", the mesh " + sizeOf(M) +
         "; --ideal needs a mesh of the same connectivity");
  int negative = 0;
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    std::array<int, 4> a = M.tets[E], b = rest.tets[E];
    const double volume = sixVolumes(rest.x, b);
    negative += volume < 0;
    if (volume == 0)
      fail(path + ": tetrahedron " + std::to_string(E) +
           " has no volume, so it is no ideal element");
    std::sort(a.begin(), a.end());
    std::sort(b.begin(), b.end());
    if (a != b)
      fail(path + ": tetrahedron " + std::to_string(E) +
           " has other nodes than in the mesh; --ideal needs a mesh of the same connectivity");
  }
  if (negative != 0 && negative != static_cast<int>(M.tets.size()))
    fail(path + ": " + std::to_string(negative) + " of " + std::to_string(M.tets.size()) +
         " tetrahedra are inverted; --ideal needs a valid mesh");
  return rest.x;
}

void runOptimize(const Arguments& a, const Streams& io) {
  const std::string path = a.output(1);
  OptimizeOptions options = optimizeOptions(a);
  checkWritable(path);
  MeshFile file = readMeshFile(a.operands[0]);
  Mesh& M = file.M;
  const bool meccano = !M.xi.empty();
  if (a.has("--ideal")) M.xi = idealNodes(a.options.at("--ideal")[0], M);
  options.fixed = interfaceNodes(M);
  options.fixed.insert(options.fixed.end(), file.required.begin(), file.required.end());
  Progress progress(io, a.has("--quiet"));
  for (const std::string& w : file.warnings) progress.warning(w);
  progress.line("mesh " + a.operands[0] + ": " + sizeOf(M));
  if (!options.fixed.empty())
    progress.line(std::to_string(options.fixed.size()) +
                  " required or labelled nodes inside stay where they are");
  const QualityStatistics original = qualityStatistics(M);
  options.onSweep = progress.sweeps();
  const OptimizeReport r = optimizeMesh(M, options);
  if (r.inverted > 0)
    throw MethodError("optimize: " + std::to_string(r.inverted) +
                      " elements are still inverted after " + std::to_string(r.sweeps) +
                      " sweeps, nothing was written; raise --max-sweeps, or the boundary does not "
                      "allow a valid mesh");
  const bool ideal = !M.xi.empty();
  const QualityStatistics regular = qualityStatistics(M, Ideal::regular);
  if (!meccano) M.xi.clear();
  writeFiles({{path, meshText(path, M, file.required)}});
  progress.line(path + ": " + sizeOf(M));
  io.out << tableI({{"original", &original}, {"smoothed", &r.quality}});
  if (ideal) io.out << regularLine(regular);
  io.out << r.sweeps << " sweeps, displacement " << format("%.3g", r.disp)
         << (r.converged ? ", converged\n" : ", stopped by --max-sweeps\n");
}

void runStats(const Arguments& a, const Streams& io) {
  const std::string histogram = a.svg("--histogram");
  if (!histogram.empty()) checkWritable(histogram);
  const Mesh M = readMesh(a.operands[0]);
  const QualityStatistics regular = qualityStatistics(M, Ideal::regular);
  io.out << a.operands[0] << ": " << sizeOf(M) << "\n";
  for (std::size_t k = 1; k <= M.surfaces.size(); ++k)
    io.out << "surface " << k << " (" << M.surfaces[k - 1].name
           << "): " << surfaceFaces(M, static_cast<int>(k)).size() << " triangles\n";
  const QualityStatistics q = qualityStatistics(M);
  if (M.xi.empty())
    io.out << tableI({{"regular", &regular}});
  else
    io.out << tableI({{"computational", &q}, {"regular", &regular}});
  if (histogram.empty()) return;
  if (!io.out.flush()) fail("standard output: the results cannot be written; nothing was written");
  const char* ideal = M.xi.empty() ? "regular tetrahedra" : "computational tetrahedra";
  writeFiles({{histogram, histogramText(q, nameOf(a.operands[0]), ideal)}});
}

/// "y=.5": a plane.
Cut parseCut(const std::string& word) {
  Cut cut;
  const std::size_t axis = word.empty() ? std::string::npos : std::string("xyz").find(word[0]);
  if (axis == std::string::npos || word.size() < 3 || word[1] != '=' ||
      !parse(std::string_view(word).substr(2), cut.value) || !std::isfinite(cut.value))
    throw UsageError("'" + word + "' is no plane for --cut; it is written x=1.5, y=1.5 or z=1.5");
  cut.axis = static_cast<int>(axis);
  return cut;
}

Colour parseColour(const std::string& word) {
  if (word == "quality") return Colour::quality;
  if (word == "level") return Colour::level;
  if (word == "surface") return Colour::surface;
  throw UsageError("'" + word + "' is no --colour; it is quality, level or surface");
}

void runPicture(const Arguments& a, const Streams& io) {
  const std::string path = a.svg("-o");
  if (path.empty()) throw UsageError("the output is missing: -o OUT.svg");
  PictureOptions o;
  if (a.has("--colour")) o.colour = parseColour(a.options.at("--colour")[0]);
  if (a.has("--cut")) o.cut = parseCut(a.options.at("--cut")[0]);
  checkWritable(path);
  const Mesh M = readMesh(a.operands[0]);
  if (!a.has("--cut") && !M.x.empty()) o.cut = defaultCut(insertedTriangles(M), M);
  o.title = nameOf(a.operands[0]);
  writeFiles({{path, pictureText(M, o)}});
  io.err << path << ": behind " << nameOf(o.cut) << std::endl;
}

void convertMesh(const std::string& in, const std::string& out, const Streams& io,
                 std::vector<std::string>& warnings) {
  const MeshFile file = readMeshFile(in);
  warnings = file.warnings;
  if (!file.M.xi.empty() && suffixOf(out) != ".vtk")
    warnings.push_back(out +
                       ": only .vtk keeps the meccano (the computational coordinates and the "
                       "geometry that `insert` needs); keep " +
                       in);
  writeFiles({{out, meshText(out, file.M, file.required)}});
  io.err << out << ": " << sizeOf(file.M) << std::endl;
}

void convertSurfaces(const std::string& in, const std::string& out, bool fromMesh,
                     const Streams& io, std::vector<std::string>& warnings) {
  const std::vector<TriangleSurface> surfaces =
      fromMesh ? insertedSurfaces(in, readMesh(in)) : readSurfaces(in, warnings);
  writeFiles({{out, surfaceText(out, surfaces, warnings)}});
  for (const TriangleSurface& S : surfaces)
    io.err << out << ": " << S.name << ", " << S.points.size() << " points, " << S.triangles.size()
           << " triangles" << std::endl;
}

void runConvert(const Arguments& a, const Streams& io) {
  const std::string &in = a.operands[0], &out = a.operands[1];
  const bool toMesh = isMeshSuffix(suffixOf(out));
  if (!toMesh && !isSurfaceSuffix(suffixOf(out)))
    throw UsageError("'" + out + "' ends neither in " + meshSuffixes + " (meshes) nor in " +
                     surfaceSuffixes + " (surfaces)");
  checkWritable(out);
  const Format from = formatOf(in, readFile(in));
  if (toMesh && !isMesh(from) && from != Format::none)
    fail(in + ": this is a surface (" + nameOf(from) + "), and " + out +
         " would be a mesh; make one with `meccano box` and `meccano insert`, or write " +
         surfaceSuffixes);
  std::vector<std::string> warnings;
  if (toMesh)
    convertMesh(in, out, io, warnings);
  else
    convertSurfaces(in, out, isMesh(from), io, warnings);
  for (const std::string& w : warnings) io.err << "meccano: warning: " << w << std::endl;
}

// ==== Commands: their options and help ===========================================================

struct Option {
  const char* name;
  const char* values;  // as the help shows them, separated by spaces; "" none
  const char* help;
};

struct Command {
  const char* name;
  const char* operands;  // as the help shows them
  const char* about;
  std::size_t least, most;  // operands
  std::vector<Option> options;
  void (*run)(const Arguments&, const Streams&);
};

constexpr Option outputOption{"-o", "OUT", "the mesh to write: .vtk, .msh (Gmsh), .mesh (MEDIT)"};
constexpr Option paperOption{"--paper", "", "the paper to the letter, not the best known choices"};
constexpr Option powerOption{
    "--power", "P", "exponent of the term that lifts the worst elements (default 64; 1: none)"};
constexpr Option threadsOption{"--threads", "N",
                               "threads (default 0: all cores); the result is the same for any"};
constexpr Option maxTetsOption{"--max-tets", "N",
                               "refuse where more tetrahedra are predicted (default 20000000)"};
constexpr Option quietOption{"--quiet", "", "no progress on standard error"};

/// The commands that make a mesh of a domain.
std::vector<Command> makingCommands() {
  return {
      {"box",
       "",
       "Makes the tetrahedral mesh of a box: six Kuhn tetrahedra for each cell.",
       0,
       0,
       {outputOption,
        {"--origin", "X Y Z", "lowest corner (default 0 0 0)"},
        {"--size", "X Y Z", "edge lengths (default 1 1 1)"},
        {"--cells", "NX NY NZ", "cells along each axis, near-cubic ones are best (default 1 1 1)"}},
       runBox},
      {"terrain",
       "DEM.asc",
       "Makes the tetrahedral mesh between a terrain and a flat top by Algorithm 1, and prints\n"
       "its quality. The terrain is an ESRI ASCII grid (heights in the unit of the cells), "
       "bilinear\n"
       "between its points.",
       1,
       1,
       {outputOption,
        {"--top", "Z", "height of the top"},
        {"--cells", "NX NY NZ",
         "cubes of the meccano (default: near-cubic, 8 along the longer side)"},
        {"--eps", "E", "largest distance from the terrain (default: .002 of the diagonal)"},
        powerOption,
        threadsOption,
        maxTetsOption,
        quietOption},
       runTerrain},
      {"solid",
       "SURFACE",
       "Makes the tetrahedral mesh of the solid inside a closed surface by Algorithm 1, and "
       "prints\n"
       "its quality. Without a polycube the meccano is a box of cubes, for solids without "
       "handles.\n"
       "A polycube file has a line `cube i j k` for each cube, and `corner i j k  x y z` for each\n"
       "corner of their union: the point of the solid where it goes.",
       1,
       1,
       {outputOption,
        {"--eps", "E", "largest distance from the surface, in the unit of the input"},
        {"--polycube", "FILE", "the meccano and where its corners go"},
        {"--fixed-boundary", "", "boundary nodes stay where the boundary mapping puts them"},
        powerOption,
        threadsOption,
        maxTetsOption,
        quietOption},
       runSolid}};
}

/// The commands that change a mesh.
std::vector<Command> changingCommands() {
  return {
      {"insert",
       "MESH.vtk SURFACE [SURFACE ...]",
       "Inserts triangulated surfaces into a mesh that meccano wrote, the largest first, and "
       "prints\n"
       "Table I: the quality of the original, refined, projected and smoothed mesh, against its\n"
       "computational elements. A surface of several components becomes several.\n"
       "Surfaces are read from OBJ, OFF, STL, PLY and GOCAD TSurf files, several of a file too.",
       2,
       1000,
       {outputOption,
        {"--lc", "L",
         "element size at the surface, eq. (1), in the unit of the input (default: chosen by the\n"
         "                       features of the surface, and told)"},
        {"--tolerance", "E",
         "instead of --lc: the coarsest size at which the two-sided Hausdorff distance of the\n"
         "                       inserted faces and the surface is at most E, unit of the input"},
        paperOption,
        powerOption,
        threadsOption,
        {"--stages", "PREFIX",
         "also write PREFIX-{original,refined,projected,smoothed}.vtk (of several surfaces\n"
         "                       PREFIX-1-refined.vtk, ...); a PREFIX that ends in / is a folder"},
        {"--pictures", "PREFIX", "also draw PREFIX_original.svg and so on, as `picture` does"},
        maxTetsOption,
        quietOption},
       runInsert},
      {"optimize",
       "MESH",
       "Untangles and smooths a tetrahedral mesh, Algorithm 2. The ideal elements are the\n"
       "computational ones where the file has them; else those of --ideal, or regular ones.\n"
       "Without a meccano the boundary, labelled faces and MEDIT's RequiredVertices stay in place.",
       1,
       1,
       {outputOption,
        {"--ideal", "REST", "a mesh of the same connectivity: its elements are the ideal ones"},
        {"--max-disp", "D", "stop below this displacement / shortest edge (default .01)"},
        {"--max-sweeps", "N", "stop after this many sweeps (default 300)"},
        paperOption,
        powerOption,
        threadsOption,
        quietOption},
       runOptimize}};
}

/// The commands that show a mesh, or write it otherwise.
std::vector<Command> showingCommands() {
  return {
      {"stats",
       "MESH",
       "Prints the quality statistics of a tetrahedral mesh, as in Table I.",
       1,
       1,
       {{"--histogram", "H.svg", "also draw the number of tetrahedra in 20 classes of quality"}},
       runStats},
      {"picture",
       "MESH",
       "Draws the tetrahedra whose centres are behind a plane, the eye being where x is high, y "
       "low\n"
       "or z high. Inserted surfaces are bold lines, orange where a face of theirs is seen;\n"
       "--colour surface shows them whole. Where too many faces are seen, edges are left out, "
       "then\n"
       "squares are drawn: the file stays below 300 kB.",
       1,
       1,
       {{"-o", "OUT.svg", "the picture to write"},
        {"--cut", "x|y|z=VALUE",
         "the plane (default: through the middle of the inserted surfaces, across them)"},
        {"--colour", "quality|level|surface",
         "quality q (default), level of bisection, or surface"}},
       runPicture},
      {"convert",
       "IN OUT",
       "Writes a mesh or surfaces in the format of OUT's suffix. Meshes: .vtk, .msh (Gmsh 2.2), "
       ".mesh\n"
       "(MEDIT); only .vtk keeps the meccano. Surfaces: .obj, .stl (binary), .off, .ply (ASCII), "
       ".ts\n"
       "(GOCAD TSurf); from a mesh its inserted surfaces. The content of IN tells its format.",
       2,
       2,
       {},
       runConvert}};
}

const std::vector<Command>& commands() {
  static const std::vector<Command> all = [] {
    std::vector<Command> joined = makingCommands();
    for (const auto& more : {changingCommands(), showingCommands()})
      joined.insert(joined.end(), more.begin(), more.end());
    return joined;
  }();
  return all;
}

std::string usageLine(const Command& c) {
  std::string line = std::string("meccano ") + c.name;
  if (*c.operands) line += std::string(" ") + c.operands;
  for (const Option& o : c.options) {
    const std::string one = std::string(o.name) + (*o.values ? " " : "") + o.values;
    const std::string name = o.name;
    const bool needed =
        name == "-o" || name == "--top" || (name == "--eps" && std::string(c.name) == "solid");
    line += needed ? " " + one : " [" + one + "]";
  }
  return line;
}

std::string help(const Command& c) {
  std::string text = "usage: " + usageLine(c) + "\n\n" + c.about + "\n";
  if (!c.options.empty()) text += "\n";
  for (const Option& o : c.options) {
    const std::string option = std::string(o.name) + " " + o.values;
    const char* layout = option.size() > 20 ? "  %s\n%23s%s\n" : "  %-20s%1s%s\n";
    text += format(layout, option.c_str(), "", o.help);
  }
  return text;
}

std::string help() {
  std::string text = std::string("meccano ") + version +
                     ": insertion of triangulated surfaces into meccano tetrahedral meshes\n\n";
  for (const Command& c : commands()) text += "  " + usageLine(c) + "\n";
  return text +
         "\n`meccano COMMAND --help` tells what a command does, `meccano --version` the version.\n"
         "Results go to standard output, progress and errors to standard error.\n"
         "Exit status: 0 done and valid, 1 an error and nothing written, 2 wrong usage.\n";
}

Arguments parseArguments(const Command& c, const std::vector<std::string>& words) {
  Arguments a;
  for (std::size_t i = 0; i < words.size(); ++i) {
    const std::string& word = words[i];
    if (word.empty() || word[0] != '-' || word == "-") {
      a.operands.push_back(word);
      continue;
    }
    const auto o = std::find_if(c.options.begin(), c.options.end(),
                                [&](const Option& option) { return word == option.name; });
    if (o == c.options.end()) throw UsageError("there is no option " + word);
    if (a.has(o->name)) throw UsageError(word + " is given twice");
    const std::string_view form = o->values;
    const std::size_t values = form.empty() ? 0 : 1 + std::count(form.begin(), form.end(), ' ');
    std::vector<std::string>& list = a.options[o->name];
    for (; list.size() < values; list.push_back(words[++i]))
      if (i + 1 == words.size() || words[i + 1].compare(0, 2, "--") == 0)
        throw UsageError(word + " needs " + o->values);
  }
  if (a.operands.size() < c.least || a.operands.size() > c.most)
    throw UsageError(c.most == 0 ? "'" + a.operands[0] + "' is too much, no file is read"
                                 : std::string("needed: ") + c.operands +
                                       ", given: " + counted(a.operands.size(), "file"));
  return a;
}

/// Does what the words after the program's name say; throws what goes wrong.
void dispatch(const std::vector<std::string>& words, const Streams& io) {
  if (words.empty()) throw UsageError("a command is missing");
  auto asked = [&](const char* option) {
    return std::find(words.begin(), words.end(), option) != words.end();
  };
  if (words[0] == "--version") {
    io.out << "meccano " << version << "\n";
    return;
  }
  if (words[0] == "--help" || words[0] == "-h") {
    io.out << help();
    return;
  }
  const auto c = std::find_if(commands().begin(), commands().end(),
                              [&](const Command& command) { return words[0] == command.name; });
  if (c == commands().end()) throw UsageError("there is no command '" + words[0] + "'");
  if (asked("--help") || asked("-h")) {
    io.out << help(*c);
    return;
  }
  c->run(parseArguments(*c, {words.begin() + 1, words.end()}), io);
}

/// The program without its process: exit status 0 done and valid, 1 an error, 2 wrong usage.
int run(const std::vector<std::string>& words, const Streams& io) {
  try {
    dispatch(words, io);
    io.out.flush();
    if (io.out) return 0;
    io.err << "meccano: the results cannot be written to standard output" << std::endl;
  } catch (const UsageError& e) {
    const bool known = !words.empty() && words[0][0] != '-' &&
                       std::any_of(commands().begin(), commands().end(),
                                   [&](const Command& c) { return words[0] == c.name; });
    io.err << "meccano: " << (known ? words[0] + ": " : "") << e.what() << "; see meccano "
           << (known ? words[0] + " " : "") << "--help" << std::endl;
    return 2;
  } catch (const std::bad_alloc&) {
    io.err << "meccano: the memory does not suffice; use a larger --lc or a coarser mesh\n";
  } catch (const std::exception& e) {
    io.err << "meccano: " << printable(e.what()) << std::endl;
  }
  return 1;
}

}  // namespace meccano::app

#ifndef MECCANO_NO_MAIN
int main(int argc, char** argv) {
  ::signal(SIGXFSZ, SIG_IGN);  // a file above the limit is an error of its write()
  const meccano::app::Streams io{std::cout, std::cerr, ::isatty(2) == 1};
  return meccano::app::run({argv + (argc > 0), argv + argc}, io);
}
#endif

// SPDX-License-Identifier: MIT
//
// The command line of the suites of rows, `make stress-real` and `make stress-solids`.
#pragma once
#include <string>
#include <vector>

namespace stress {

struct Arguments {
  std::string data = "../shared/data", write;
  bool list = false, exact = false, verbose = false, usage = false;
  std::vector<std::string> texts;
};

inline Arguments parse(int argc, char** argv) {
  Arguments a;
  for (int i = 1; i < argc; ++i) {
    const std::string arg = argv[i];
    if (arg == "--list")
      a.list = true;
    else if (arg == "--exact")
      a.exact = true;
    else if (arg == "--verbose")
      a.verbose = true;
    else if (arg == "--data" && i + 1 < argc)
      a.data = argv[++i];
    else if (arg == "--write" && i + 1 < argc)
      a.write = argv[++i];
    else if (arg[0] == '-')
      a.usage = true;
    else
      a.texts.push_back(arg);
  }
  return a;
}

/// Whether a row is asked for. Slow rows are by their whole name only.
inline bool isSelected(const std::string& name, bool slow, const Arguments& a) {
  if (a.texts.empty()) return !slow || a.list;
  for (const std::string& text : a.texts)
    if (name == text || (!slow && !a.exact && name.find(text) != std::string::npos)) return true;
  return false;
}

}  // namespace stress

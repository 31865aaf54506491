// SPDX-License-Identifier: MIT
// The doctest main; every other file of this folder holds the cases of one subsection.
#define DOCTEST_CONFIG_IMPLEMENT_WITH_MAIN
#include <doctest/doctest.h>

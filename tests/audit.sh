#!/bin/sh
# SPDX-License-Identifier: MIT
#
# Prints equation -> function -> file:line -> test for Eqs. (1)-(11), Algorithms 1-2 and the six
# cases of 3.5, and every [choice] and [departure] with its place in the README. Exit status 1 if
# something lacks its tag, its function, its test or its entry. Three conventions are all it needs:
#   tag     a comment holding [§..., eq. (N)], [§3.5.N] or [§..., Algorithm N] stands before the
#           function; a declaration in meccano.hpp counts with its definition in a .cpp
#   test    TEST_CASE("eq. (N): ..."), ("case N: ...") or ("Algorithm N: ...") in tests/; one case
#           may serve several, as "eq. (10), (11): ..."
#   README  the section "Choices and departures" names in `backticks` the function, type or member
#           that carries the [choice] or [departure]: the one after the comment, or around it
cd "$(dirname "$0")/.." || exit 1
sources='meccano.hpp insert.cpp optimize.cpp main.cpp'
present=''
for f in $sources README.md tests/test_*.cpp; do [ -f "$f" ] && present="$present $f"; done

# shellcheck disable=SC2086
LC_ALL=C awk '
function nameOf(line,   s, n) {  # the identifier a code line declares
  s = line
  sub(/\/\/.*/, "", s)
  sub(/^[ \t]*/, "", s)
  if (s ~ /^(struct|class|enum class|enum|namespace) /) {
    sub(/^(struct|class|enum class|enum|namespace) +/, "", s)
    sub(/[^A-Za-z0-9_].*/, "", s)
    return s
  }
  if (s !~ /^(inline )?(static )?constexpr .*=/ && match(s, /[A-Za-z_][A-Za-z0-9_]*\(/))
    return substr(s, RSTART, RLENGTH - 1)
  sub(/[ \t]*[={;[].*/, "", s)
  n = match(s, /[A-Za-z_][A-Za-z0-9_]*$/)
  return n ? substr(s, RSTART, RLENGTH) : ""
}
function tagsOf(text, name, place,   rest, tag, i) {  # what the brackets of a comment claim
  rest = text
  while ((i = index(rest, "[§")) > 0) {
    rest = substr(rest, i + 1)
    tag = substr(rest, 1, index(rest, "]"))
    if (tag ~ /eq\. \(/)
      for (i = 1; i <= 11; ++i) if (index(tag, "(" i ")")) claim("eq. (" i ")", name, place)
    for (i = 1; i <= 6; ++i) if (tag ~ ("3\\.5\\." i "[^0-9]")) claim("case " i, name, place)
    for (i = 1; i <= 2; ++i) if (index(tag, "Algorithm " i)) claim("Algorithm " i, name, place)
  }
}
function claim(what, name, place) {
  tagged[what] = place
  if (name != "") { ++claims; claimWhat[claims] = what; claimName[claims] = name }
}
function tested(what, place) { if (!(what in test)) test[what] = place }
function decide(text, name, place,   kind) {  # remembers a choice or a departure
  if (index(text, "Tags:")) return
  for (kind = 1; kind <= 2; ++kind)
    if (text ~ (kind == 1 ? "choice\\]|choice," : "departure\\]|departure,") && text ~ /\[/) {
      ++decisions
      decisionName[decisions] = name; decisionPlace[decisions] = place
      decisionKind[decisions] = kind == 1 ? "choice" : "departure"
    }
}
function isFunction(line) {
  return index(line, "(") && line !~ /^[ \t]*(struct|class|enum|namespace|constexpr|#)/
}
FNR == 1 { block = ""; around = ""; header = FILENAME ~ /\.hpp$/; pending = 0; inSection = 0 }
FILENAME == "README.md" {
  if ($0 ~ /^#+ /) inSection = tolower($0) ~ /choices and departures/
  if (inSection) readme = readme $0 "\n"
  next
}
FILENAME ~ /^tests\// {
  if (!match($0, /TEST_CASE\("[^"]*/)) next
  title = substr($0, RSTART + 11, RLENGTH - 11)
  head = substr(title, 1, index(title ":", ":") - 1)
  place = FILENAME ":" FNR
  for (i = 1; i <= 11; ++i)
    if (head ~ /^eq\. \(/ && index(head, "(" i ")")) tested("eq. (" i ")", place)
  for (i = 1; i <= 6; ++i)
    if (head ~ /^cases? / && head ~ ("(^|[^0-9])" i "([^0-9]|$)")) tested("case " i, place)
  for (i = 1; i <= 2; ++i)
    if (head ~ ("^Algorithm " i)) tested("Algorithm " i, place)
  next
}
/^[ \t]*$/ || /^template / { next }
/^[ \t]*\/\// {  # a comment line: it speaks for the code after it, or inside a function for that
  if ($0 ~ /^\/\// || header) {
    block = block $0 "\n"
    waiting[++pending] = $0; waitingPlace[pending] = FILENAME ":" FNR
  } else {
    decide($0, around, FILENAME ":" FNR)
  }
  next
}
{
  if ($0 ~ /^[A-Za-z]/ || (header && $0 ~ /[^ \t]/)) {
    name = nameOf($0)
    if (block != "") tagsOf(block, isFunction($0) ? name : "", FILENAME ":" FNR)
    for (i = 1; i <= pending; ++i) decide(waiting[i], name, waitingPlace[i])
    if (!header && $0 ~ /^[A-Za-z]/ && (isFunction($0) || $0 ~ /^(struct|class) /)) around = name
    if ($0 ~ /^[A-Za-z]/ && isFunction($0) && $0 !~ /;[ \t]*(\/\/.*)?$/ && !(name in defined))
      defined[name] = FILENAME ":" FNR
  } else {
    for (i = 1; i <= pending; ++i) decide(waiting[i], "", waitingPlace[i])
  }
  if (i = index($0, "//"))
    decide(substr($0, i), header || $0 ~ /^[A-Za-z]/ ? nameOf($0) : around, FILENAME ":" FNR)
  block = ""; pending = 0
}
function row(what,   i, name, why) {
  for (i = 1; i <= claims && name == ""; ++i)
    if (claimWhat[i] == what && claimName[i] in defined) name = claimName[i]
  if (!(what in tagged)) why = "no tag"
  else if (name == "") why = "no function after its tag (" tagged[what] ")"
  else if (!(what in test)) why = "no test"
  printf "%-12s %-24s %-20s %s\n", what, name == "" ? "-" : name, \
    name == "" ? "-" : defined[name], why == "" ? test[what] : "MISSING: " why
  if (why != "") lacks = lacks "\n  " what ": " why
}
END {
  printf "%-12s %-24s %-20s %s\n", "paper", "function", "defined", "test"
  for (i = 1; i <= 11; ++i) row("eq. (" i ")")
  row("Algorithm 1")
  row("Algorithm 2")
  for (i = 1; i <= 6; ++i) row("case " i)
  printf "\n%-12s %-24s %-20s %s\n", "tag", "at", "place", "README"
  for (i = 1; i <= decisions; ++i) {
    name = decisionName[i]
    found = name != "" && (index(readme, "`" name "`") || index(readme, "`" name "("))
    printf "%-12s %-24s %-20s %s\n", decisionKind[i], name == "" ? "-" : name, decisionPlace[i], \
      found ? "named" : "MISSING"
    if (!found)
      lacks = lacks "\n  " decisionKind[i] " at " decisionPlace[i] \
        (name == "" ? ": no declaration after it" : ": README does not name `" name "`")
  }
  if (lacks == "") print "\nnothing is missing"
  else { print "\nmissing:" lacks; exit 1 }
}' $present

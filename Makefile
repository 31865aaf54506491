# SPDX-License-Identifier: MIT
# make            ./meccano                     make test    all tests (finds or fetches doctest)
# make demo       Figure 8, beside Table I      make audit   equation -> function -> test
# make asan       the tests with sanitizers     make stress  200 random surfaces
# make bench      time of each stage            make samples samples/ anew from its generator
# make pictures   samples/cube_sine/*.svg       make faults  four faults in a box, samples/faults
# make stress-real  the surfaces of ../shared/data, where it is
# make stress-solids  Algorithm 1 on solids, terrains, layers, those of ../shared/data where it is
# make pollutant  Section 4.3.2 on samples/layers: wind, transport, files in build/pollutant
# make bench-peers  Gmsh beside us on one surface, where it is installed
# make bench-optimize  the optimizer on the cases of ../shared/bench, where it is
CXX      ?= g++
CXXFLAGS ?= -O3 -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wno-sign-conversion
EXTRA    ?=
BUILD    ?= build
PROGRAM  ?= meccano
CASES    ?= ../shared/bench/make_cases.py

COMPILE = $(CXX) -std=c++17 $(CXXFLAGS) $(EXTRA) -ffp-contract=off -pthread
LIBRARY = $(BUILD)/insert.o $(BUILD)/optimize.o
TESTS   = $(BUILD)/tests/run.o $(patsubst %.cpp,$(BUILD)/%.o,$(sort $(wildcard tests/test_*.cpp)))
DEMO    = $(BUILD)/demo
DOCTEST = $(BUILD)/doctest.flags
ASAN    = $(BUILD)/asan
SANITIZE  = -fsanitize=address,undefined -fno-sanitize-recover=all
SANITIZED = $(patsubst %,$(ASAN)/%.o,insert optimize \
              tests/test_files tests/test_pictures tests/test_432_pollutant)

all: $(PROGRAM)

$(PROGRAM): $(BUILD)/main.o $(LIBRARY)
	$(COMPILE) $^ -o $@
$(BUILD)/%: $(BUILD)/%.o $(LIBRARY)
	$(COMPILE) $^ -o $@
$(BUILD)/tests/run: $(TESTS) $(LIBRARY)
	$(COMPILE) $^ -o $@
$(BUILD)/%.o: %.cpp
	@mkdir -p $(@D)
	$(COMPILE) $$(cat $(DOCTEST) 2>/dev/null) -MMD -MP -c $< -o $@
$(TESTS): $(DOCTEST)

# <doctest/doctest.h> where the compiler finds it; else Debian's package, installed or unpacked.
$(DOCTEST):
	@mkdir -p $(BUILD)
	@fetch() { "$$@" apt-get install -y -q doctest-dev || \
	    { "$$@" apt-get update -q && "$$@" apt-get install -y -q doctest-dev; }; }; \
	if echo '#include <doctest/doctest.h>' | $(CXX) -E -x c++ - >/dev/null 2>&1; then :; \
	elif ! command -v apt-get >/dev/null; then \
	  echo 'make test: install doctest 2.4.9 or later so that <doctest/doctest.h> is found'; exit 1; \
	elif [ "$$(id -u)" = 0 ]; then fetch env; \
	elif sudo -n true 2>/dev/null; then fetch sudo -n; \
	else (cd $(BUILD) && apt-get download doctest-dev && dpkg -x doctest-dev_*.deb doctest) && \
	  echo '-isystem $(BUILD)/doctest/usr/include' > $@; fi && touch $@

test: $(BUILD)/tests/run
	$(BUILD)/tests/run $(ARGS)
# Sanitized are the library, main.cpp and pollutant.cpp; the other tests are the objects of `test`.
asan: $(TESTS)
	$(MAKE) BUILD=$(ASAN) CXXFLAGS='-O2 -g1 $(SANITIZE)' $(SANITIZED)
	$(CXX) $(SANITIZE) -pthread $(SANITIZED) \
	  $(filter-out $(SANITIZED:$(ASAN)/%=$(BUILD)/%),$(TESTS)) -o $(ASAN)/run
	$(MAKE) asan-3 asan-others
asan-3:
	$(ASAN)/run -ts='3*'
asan-others:
	$(ASAN)/run -tse='3*'

demo: $(PROGRAM)
	@mkdir -p $(DEMO)
	./$(PROGRAM) box --cells 2 2 2 -o $(DEMO)/cube.vtk
	./$(PROGRAM) insert $(DEMO)/cube.vtk samples/cube_sine/sine.obj --lc .12 \
	  --stages $(DEMO)/cube_sine --pictures $(DEMO)/cube_sine -o $(DEMO)/cube_sine.vtk \
	  > $(DEMO)/table.txt
	@awk 'BEGIN { p["Table"] = "paper: original projected smoothed"; p["inverted"] = "0 58 0"; \
	    p["min"] = "1 0 0.35"; p["max"] = "1 1 0.99"; p["mean"] = "1 0.74 0.92"; \
	    p["std"] = "0 0.33 0.10" } \
	  { n = split(p[$$1], c, " "); line = $$0 (n ? "   |" : ""); if (n == 3) line = line "      "; \
	    for (i = 1; i <= n; ++i) line = line sprintf(" %10s", c[i]); print line }' $(DEMO)/table.txt

# The pictures of samples/ anew: copies of the demo's, and Figure 9's two histograms.
pictures: demo
	cp $(DEMO)/cube_sine_*.svg samples/cube_sine
	for s in projected smoothed; do ./$(PROGRAM) stats $(DEMO)/cube_sine-$$s.vtk \
	  --histogram samples/cube_sine/histogram_$$s.svg > $(DEMO)/stats.txt || exit 1; done
faults: $(PROGRAM)
	@mkdir -p $(DEMO)
	./$(PROGRAM) box --size 4 3 2 --cells 4 3 2 -o $(DEMO)/box.vtk
	./$(PROGRAM) insert $(DEMO)/box.vtk $(patsubst %,samples/faults/%.ts,west east ring lobe) \
	  --lc .12 -o $(DEMO)/faults.vtk
	./$(PROGRAM) picture $(DEMO)/faults.vtk --colour surface --cut y=2.5 \
	  -o samples/faults/faults.svg
samples: $(BUILD)/samples/generate
	$(BUILD)/samples/generate samples
pollutant: $(BUILD)/samples/pollutant/pollutant
	$< samples/layers/island.asc samples/layers/layer_1000.obj samples/layers/layer_2000.obj \
	  --lc 870 -o $(BUILD)/pollutant $(ARGS)
audit:
	@sh tests/audit.sh
stress bench: %: $(BUILD)/tests/%
	$(BUILD)/tests/$@ $(ARGS)
bench-optimize: $(BUILD)/tests/bench_optimize
	@mkdir -p $(BUILD)/cases
	@if [ -e $(CASES) ] && [ ! -e $(BUILD)/cases/turn_3.0.mesh ]; then \
	  for p in python3 /usr/bin/python3; do \
	    $$p $(CASES) $(BUILD)/cases 2>/dev/null && break; done; fi
	$< $(BUILD)/cases $(ARGS)
bench-peers: $(PROGRAM)
	@sh tests/bench_peers.sh $(abspath $(PROGRAM)) $(BUILD)/peers
stress-real stress-solids: stress-%: $(BUILD)/tests/stress_%
	$< $(ARGS)
clean:
	rm -rf $(BUILD) $(PROGRAM)

.PHONY: all demo pictures faults test audit asan asan-3 asan-others stress stress-real \
  stress-solids bench bench-optimize bench-peers samples pollutant clean
.SECONDARY:
-include $(wildcard $(BUILD)/*.d $(BUILD)/*/*.d $(BUILD)/*/*/*.d)

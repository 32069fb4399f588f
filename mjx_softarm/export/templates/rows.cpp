// Answers golden rows: reads rows of numbers, writes the outputs of each (python -m pydoc mjx_softarm.export.golden).
#include <cstdio>

#include "softarm.hpp"

using softarm::kChambers, softarm::kSprings;

static void write(const double* values, int n) {
  for (int k = 0; k < n; ++k) std::printf(" %.17g", values[k]);
}

int main() {
  std::printf("mjx_softarm @PROGRAM_VERSION@ %s\n", softarm::kPolicySha256);
  std::fflush(stdout);
  softarm::Controller controller;
  constexpr int n_flags = @N_FLAGS@, n_inputs = n_flags + kSprings + 6;
  double row[n_inputs];
  float nearest[6];
  const double *readings = row + n_flags, *goal = readings + kSprings;
  for (long line = 1;; ++line) {
    for (int k = 0; k < n_inputs; ++k) {
      if (std::scanf("%lf", &row[k]) == 1) continue;
      if (k == 0 && std::feof(stdin)) return 0;
      std::fprintf(stderr, "row %ld: got %d numbers, expected %d\n", line, k, n_inputs);
      return 2;
    }
    if (row[0] > 0.5) controller = softarm::Controller{};
    const bool no_way = row[5] > 0.5 && !softarm::reaches(goal, nearest);
    const bool refused = row[1] > 0.5 && (no_way || !controller.set_goal(goal));
    if (row[4] > 0.5) controller.vent(softarm::ARM_LOST);
    const softarm::Tick tick = controller.tick(readings, row[2] > 0.5, row[3] > 0.5);
    double reference[kSprings], length[kSprings];
    float pose[6];
    controller.references(reference);
    controller.lengths(length);
    controller.tip(pose);
    std::printf("%u %d", tick.faults | (refused ? softarm::GOAL_OUTSIDE : 0u), tick.arrived);
    write(tick.pressure_kpa, kChambers);
    write(reference, kSprings);
    write(length, kSprings);
    for (const float value : pose) std::printf(" %.9g", value);
    std::printf("\n");
    std::fflush(stdout);
  }
}

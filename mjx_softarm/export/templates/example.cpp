// Brings the tip to a goal. Write the two functions below for your arm; softarm.hpp holds the rest.
#include <chrono>
#include <csignal>
#include <cstdio>
#include <thread>

#include "softarm.hpp"

using softarm::kChambers, softarm::kSprings;
using Clock = std::chrono::steady_clock;

// Reads the springs' sensors, NaN for a reading that is late or missing; returns false if they are not reached.
static bool read_sensors(double* readings) {
  for (int k = 0; k < kSprings; ++k) readings[k] = NAN;
  return true;
}

// Commands the chambers' pressures [kPa]; returns false if the arm did not take them in time.
static bool write_pressures(const double* pressure_kpa) {
  for (int k = 0; k < kChambers; ++k) std::printf("%.1f%c", pressure_kpa[k], k + 1 < kChambers ? ' ' : '\n');
  return true;
}

// Ctrl-C and SIGTERM vent the arm; a second signal ends at once, with the arm under pressure.
static volatile std::sig_atomic_t ends = 0;
static void end(int signal) {
  ends = 1;
  std::signal(signal, SIG_DFL);
}

int main() {
  std::signal(SIGINT, end);
  std::signal(SIGTERM, end);
  const double goal[6] = {@GOAL@};  // x, y, z [mm], yaw, pitch, roll [deg]
  float nearest[6];
  softarm::Controller controller;
  if (!softarm::reaches(goal, nearest) || !controller.set_goal(goal)) return 1;  // outside the workspace
  const std::chrono::duration<double> period(softarm::kPeriod);
  bool late = false, taken = true;
  softarm::Tick tick{};
  for (auto next = Clock::now() + period; !(tick.vented && taken); next += period) {
    double readings[kSprings];
    if (!read_sensors(readings)) controller.vent(softarm::ARM_LOST);
    if (ends) controller.vent();
    tick = controller.tick(readings, late, taken);
    taken = write_pressures(tick.pressure_kpa);
    if (tick.faults) std::printf("faults: %#x%s\n", tick.faults, tick.stopped ? ", vents" : "");
    if (tick.arrived) controller.vent();  // or set_goal() to the next one
    if ((late = Clock::now() > next)) next = Clock::now();
    std::this_thread::sleep_until(next);
  }
}

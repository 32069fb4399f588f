// A board that runs the firmware on the host: converters by TI's registers, chambers, and a line.
//
// usage: board FD SPEED. FD is an end of the line. Each loop() takes a millisecond of the board's time, which
// goes SPEED times as fast as ours, or slower on a busy host. Lines on standard input change the hardware, or
// ask for the board's time [s]:
//   gone PORT ADDRESS   reset PORT ADDRESS   flag PORT ADDRESS BITS   leak CHAMBER   wire CHAMBER COUNT
// or ask for the time [s], or a chamber's pressure [kPa]:
//   time   kpa CHAMBER

#include "firmware.ino"

#include <poll.h>
#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <map>
#include <sstream>
#include <string>
#include <utility>

Line Serial;
Bus Wire;

namespace {

constexpr double LOOP_S = 0.001;
int tty = -1;
double now_s = 0.0;

double seconds() { return now_s; }

void fail(const std::string &why) {
  std::cerr << why << std::endl;
  std::exit(1);
}

// ---- Converters: coil c of the firmware oscillates at 2 MHz + 0.3 MHz c ------------------------------------

struct Chip {
  std::map<int, uint16_t> registers;
  std::map<int, uint32_t> data;
  std::map<int, double> hz;
  double next_s = 0.0;
  int pointer = 0, flags = 0;
  bool gone = false;

  Chip() { reset(); }
  void reset() { registers = {{0x1A, 0x2801}, {0x1B, 0x020F}, {0x18, 0}, {0x19, 0}}, data.clear(); }

  void convert() {  // all channels of its round
    if (registers[0x1A] & 0x2000 || seconds() < next_s) return;
    if ((registers[0x1A] & 0x1200) != 0x1200) fail("converter: expected the external clock, current as set");
    const bool turns = registers[0x1B] >> 15;
    const int n = 2 + (registers[0x1B] >> 13 & 3), only = registers[0x1A] >> 14;
    for (const auto &coil : hz) {
      if (turns ? coil.first >= n : coil.first != only) continue;
      if (registers[0x1E + coil.first] != 18 << 11) fail("converter: expected a current of 18");
      const double reference_hz = 40e6 / (registers[0x14 + coil.first] & 0x3FF);
      const double coil_hz = coil.second / (registers[0x14 + coil.first] >> 12);
      if (reference_hz > (turns ? 40e6 : 35e6) || coil_hz >= reference_hz / 4)
        fail("converter: expected a reference of 40 MHz at most, of one channel 35 MHz, and a coil below a quarter");
      const double conversion_s = 16 * registers[0x08 + coil.first] / reference_hz;
      if (std::abs(conversion_s - 0.004) > 1e-4) fail("converter: expected conversions of 4 ms");
      next_s = seconds() + 2 * conversion_s;
      data[coil.first] = static_cast<uint32_t>(std::lround(coil_hz / reference_hz * (1 << 28))) | flags << 28;
      registers[0x18] = static_cast<uint16_t>(registers[0x18] | 1 << (3 - coil.first));
    }
  }

  void write(const std::string &bytes) {
    pointer = static_cast<uint8_t>(bytes[0]);
    if (bytes.size() == 1) return;
    if (pointer == 0x1C) return reset();
    if (pointer != 0x1A && !(registers[0x1A] & 0x2000)) fail("converter: expected changes only asleep");
    registers[pointer] = static_cast<uint16_t>(static_cast<uint8_t>(bytes[1]) << 8 | static_cast<uint8_t>(bytes[2]));
  }

  uint16_t read() {
    convert();
    if (pointer > 7) return registers[pointer];
    const int channel = pointer / 2;
    if (pointer % 2) registers[0x18] = static_cast<uint16_t>(registers[0x18] & ~(1 << (3 - channel)));
    return static_cast<uint16_t>(pointer % 2 ? data[channel] & 0xFFFF : data[channel] >> 16);
  }
};

std::map<std::pair<int, int>, Chip> chips;
int port = -1, addressed = 0;
std::string sent, received;

Chip *found(int address) {
  const auto chip = chips.find({port, address});
  return chip == chips.end() || chip->second.gone ? nullptr : &chip->second;
}

// ---- Chambers: a valve moves the pressure towards +100 or -100 kPa with a time constant of 0.5 s ---------------

double kpa[N_CHAMBERS], at_s = 0.0;
bool leaks[N_CHAMBERS];
std::map<int, int> cut;  // counts that sensors with a cut wire read, whatever the pressure is
std::map<int, int> levels;

void flow() {
  const double dt_s = seconds() - at_s;
  at_s += dt_s;
  for (int k = 0; k < N_CHAMBERS; ++k) {
    const double to = 100.0 * (levels[FILL_PIN[k]] - levels[DRAIN_PIN[k]]);
    if (levels[FILL_PIN[k]] && levels[DRAIN_PIN[k]]) fail("valves: expected one open at most");
    if (to != 0.0) kpa[k] += (to - kpa[k]) * (1.0 - std::exp(-dt_s / 0.5));
    if (leaks[k]) kpa[k] *= std::exp(-dt_s / 0.005);
  }
}

void change(const std::string &text) {
  std::istringstream words(text);
  std::string what;
  int a = 0, b = 0, c = 0;
  words >> what >> a >> b >> c;
  if (what == "time") std::cout << seconds() << std::endl;
  if (what == "kpa") flow(), std::cout << kpa[a] << std::endl;
  if (what == "leak") leaks[a] = true;
  if (what == "wire") cut[a] = b;
  if (what == "gone") chips.at({a, b}).gone = true;
  if (what == "reset") chips.at({a, b}).reset();
  if (what == "flag") chips.at({a, b}).flags = c;
}

}  // namespace

unsigned long millis() { return static_cast<unsigned long>(1e3 * seconds()); }
void pinMode(uint8_t, uint8_t) {}
void analogReadResolution(int bits) {
  if (bits != 12) fail("analogReadResolution: expected 12 bits");
}
void digitalWrite(uint8_t pin, uint8_t level) {
  flow();
  levels[pin] = level;
}
int analogRead(uint8_t pin) {
  flow();
  for (int k = 0; k < N_CHAMBERS; ++k)
    if (SENSOR_PIN[k] == pin)
      return cut.count(k) ? cut[k] : static_cast<int>(std::lround((kpa[k] + 100.0) / 200.0 * 4095));
  fail("analogRead: expected the pin of a sensor");
  return 0;
}

void Line::begin(unsigned long) {}
int Line::available() {
  pollfd ready = {tty, POLLIN, 0};
  return poll(&ready, 1, 0) > 0 && (ready.revents & POLLIN);
}
int Line::read() {
  char next = 0;
  return ::read(tty, &next, 1) == 1 ? next : -1;
}
void Line::print(const char *text) {
  if (::write(tty, text, strlen(text)) < 0) fail("line: cannot be written");
}
void Line::print(unsigned long number) { print(std::to_string(number).c_str()); }
void Line::print(float value, int digits) {
  char text[64];
  snprintf(text, sizeof text, "%.*f", digits, static_cast<double>(value));
  print(text);
}

void Bus::begin() {}
void Bus::setClock(uint32_t) {}
void Bus::beginTransmission(uint8_t address) { addressed = address, sent.clear(); }
void Bus::write(uint8_t byte) { sent.push_back(static_cast<char>(byte)); }
uint8_t Bus::endTransmission(bool) {
  for (const auto &level : levels)
    if (level.second) fail("valves: expected all closed during a transfer, which may hang");
  if (addressed == MULTIPLEXER) {
    for (port = 0; !(sent[0] >> port & 1); ++port) {
    }
    return 0;
  }
  Chip *chip = found(addressed);
  if (!chip) return 2;  // not acknowledged
  chip->write(sent);
  return 0;
}
uint8_t Bus::requestFrom(uint8_t address, uint8_t n) {
  Chip *chip = found(address);
  if (!chip || n != 2) return 0;
  const uint16_t word = chip->read();
  received = {static_cast<char>(word >> 8), static_cast<char>(word & 0xFF)};
  return 2;
}
int Bus::read() {
  const int byte = static_cast<uint8_t>(received[0]);
  received.erase(0, 1);
  return byte;
}

int main(int, char **words) {
  tty = std::atoi(words[1]);
  const double speed = std::atof(words[2]);
  for (int k = 0; k < N_SPRINGS; ++k)
    chips[{COILS[k].port, COILS[k].address}].hz[COILS[k].channel] = 2e6 + 0.3e6 * k;
  std::ios::sync_with_stdio(false);  // so that in_avail() tells what was read
  setup();
  for (std::string text;;) {
    loop();
    pollfd input = {0, POLLIN, 0};
    while (std::cin.rdbuf()->in_avail() > 0 || poll(&input, 1, 0) > 0) {
      if (!std::getline(std::cin, text)) return 0;
      change(text);
    }
    now_s += LOOP_S;
    usleep(static_cast<useconds_t>(1e6 * LOOP_S / speed));
  }
}

// Reference firmware of an arm: LDC1612 converters read its springs, two valves a chamber hold its pressures.
//
// It answers the lines of `python -m pydoc mjx_softarm.deploy.drivers.serial_line` and keeps the pressures between
// them. Without a `P` line for a second it lets all pressures go to zero. It needs a board
// with 3.3 V, some 40 pins and USB, such as a Teensy 4.1; begin with your numbers.
//
// Readings of nine springs take some 5 ms on I2C, and a bus that hangs may stop loop(): all valves are closed
// before a transfer. A board without a timeout of its Wire stops for good then, and keeps its pressures: turn its
// watchdog on. Wire the valves so that they are closed while the board starts.
// `python -m mjx_softarm firmware --spec arm.toml` writes a copy with the numbers of your arm.

#include <Arduino.h>
#include <Wire.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

// ---- Your numbers ---------------------------------------------------------------------------------------

constexpr int N_SPRINGS = 9;
constexpr int N_CHAMBERS = 9;
constexpr float MIN_KPA = -40.0f;  // pressures beyond these are refused
constexpr float MAX_KPA = 20.0f;

// Converter and channel of each spring, and the port of an I2C multiplexer (TCA9548A) in front of it.
struct Coil {
  uint8_t port, address, channel;
};
constexpr Coil COILS[] = {{0, 0x2A, 0}, {0, 0x2A, 1}, {0, 0x2B, 0}, {1, 0x2A, 0}, {1, 0x2A, 1},
                          {1, 0x2B, 0}, {2, 0x2A, 0}, {2, 0x2A, 1}, {2, 0x2B, 0}};
constexpr uint8_t MULTIPLEXER = 0x70;  // its address
constexpr uint8_t DRIVE_CURRENT = 18;  // 0 to 31; the amplitude at a coil should be 1.2 to 1.8 V

// Of each chamber: the valve to the supply, the valve to the vacuum (or the open air), the pressure sensor.
constexpr uint8_t FILL_PIN[] = {0, 1, 2, 3, 4, 5, 6, 7, 8};
constexpr uint8_t DRAIN_PIN[] = {9, 10, 11, 12, 24, 25, 28, 29, 30};
constexpr uint8_t SENSOR_PIN[] = {14, 15, 16, 17, 20, 21, 22, 23, 26};
// Sensor's pressure at 0 V and at the converter's full range. Both lie beyond the limits, so that a cut wire,
// which reads one of them, is no pressure of the arm.
constexpr float KPA_AT_0 = -100.0f;
constexpr float KPA_AT_FULL = 100.0f;
constexpr int ADC_BITS = 12;
constexpr int ADC_END = 20;  // counts from either end in which a sensor's wire counts as cut
constexpr float DEADBAND_KPA = 0.3f;  // both valves are closed this close to the set point

// ---- Numbers that fit most arms -------------------------------------------------------------------------

constexpr unsigned long BAUD = 921600;
constexpr unsigned long SILENT_MS = 1000;  // time without a `P` after which the computer counts as gone
constexpr float VENT_KPA_PER_S = 20.0f;    // as the computer vents
constexpr float CLOCK_HZ = 40e6f;          // external clock of the converters
// Divider of both clocks, coil and reference, of a converter with one coil: its reference may be 35 MHz at most,
// with several coils 40 MHz (data sheet, "Clocking Architecture"). Their ratio, which is read, stays as it is.
constexpr uint16_t DIVIDER_OF_ONE = 2;
constexpr float CONVERSION_S = 0.004f;
constexpr float SETTLE_S = 2e-5f;
constexpr size_t LONGEST = 512;  // characters of a line

constexpr float KPA_AT_END = (KPA_AT_FULL - KPA_AT_0) * ADC_END / ((1 << ADC_BITS) - 1);
static_assert(KPA_AT_0 + KPA_AT_END < MIN_KPA, "KPA_AT_0: expected a sensor that reads pressures below MIN_KPA");
static_assert(KPA_AT_FULL - KPA_AT_END > MAX_KPA, "KPA_AT_FULL: expected a sensor that reads pressures above MAX_KPA");
static_assert(sizeof COILS / sizeof COILS[0] == N_SPRINGS, "COILS: expected one for each spring");
static_assert(sizeof FILL_PIN == N_CHAMBERS, "FILL_PIN: expected one for each chamber");
static_assert(sizeof DRAIN_PIN == N_CHAMBERS, "DRAIN_PIN: expected one for each chamber");
static_assert(sizeof SENSOR_PIN == N_CHAMBERS, "SENSOR_PIN: expected one for each chamber");

// ---- Converters: registers of TI's data sheet SNOSCY9, channel 0 where there is one for each -----------------

enum Register : uint8_t {
  DATA_MSB = 0x00,
  RCOUNT = 0x08,
  SETTLECOUNT = 0x10,
  CLOCK_DIVIDERS = 0x14,
  STATUS = 0x18,
  ERROR_CONFIG = 0x19,
  CONFIG = 0x1A,
  MUX_CONFIG = 0x1B,
  RESET_DEV = 0x1C,
  DRIVE = 0x1E
};

bool select(const Coil &coil) {
  Wire.beginTransmission(MULTIPLEXER);
  Wire.write(static_cast<uint8_t>(1u << coil.port));
  return Wire.endTransmission() == 0;
}

void writeRegister(const Coil &coil, uint8_t address, uint16_t value) {
  Wire.beginTransmission(coil.address);
  Wire.write(address);
  Wire.write(static_cast<uint8_t>(value >> 8));
  Wire.write(static_cast<uint8_t>(value & 0xFF));
  Wire.endTransmission();
}

bool readRegister(const Coil &coil, uint8_t address, uint16_t &value) {
  Wire.beginTransmission(coil.address);
  Wire.write(address);
  if (Wire.endTransmission(false) != 0) return false;
  if (Wire.requestFrom(coil.address, static_cast<uint8_t>(2)) != 2) return false;
  value = static_cast<uint16_t>(Wire.read() << 8);
  value = static_cast<uint16_t>(value | Wire.read());
  return true;
}

bool sameChip(const Coil &a, const Coil &b) { return a.port == b.port && a.address == b.address; }

// Set the converter of a coil going round the channels that it has coils at.
void startConverter(const Coil &coil) {
  if (!select(coil)) return;
  writeRegister(coil, RESET_DEV, 0x8000);  // into sleep mode
  int n = 0;
  for (const Coil &other : COILS) n += sameChip(coil, other);
  const uint16_t divider = n == 1 ? DIVIDER_OF_ONE : 1;
  const float steps_per_s = CLOCK_HZ / divider / 16;
  uint8_t last = 0;
  for (const Coil &other : COILS) {
    if (!sameChip(coil, other)) continue;
    const uint8_t channel = other.channel;
    writeRegister(coil, RCOUNT + channel, static_cast<uint16_t>(CONVERSION_S * steps_per_s));
    writeRegister(coil, SETTLECOUNT + channel, static_cast<uint16_t>(SETTLE_S * steps_per_s));
    writeRegister(coil, CLOCK_DIVIDERS + channel, static_cast<uint16_t>(divider << 12 | divider));
    writeRegister(coil, DRIVE + channel, static_cast<uint16_t>(DRIVE_CURRENT << 11));
    last = channel > last ? channel : last;
  }
  writeRegister(coil, ERROR_CONFIG, 0xF800);  // errors are flagged beside the data
  // One channel all the time, or channels 0 to 1, 2 or 3 in turn; inputs up to 10 MHz; external clock
  const uint16_t sequence = n > 1 ? 0x8000 | (last > 1 ? (last - 1) << 13 : 0) : 0;
  writeRegister(coil, MUX_CONFIG, static_cast<uint16_t>(sequence | 0x020D));
  writeRegister(coil, CONFIG, static_cast<uint16_t>((n > 1 ? 0 : last << 14) | 0x1E01));
}

// Return a coil's frequency [Hz]; NaN without a new conversion, or with an error of it.
float readCoil(const Coil &coil) {
  uint16_t status, high, low;
  if (!select(coil) || !readRegister(coil, STATUS, status)) return NAN;
  if (!(status >> (3 - coil.channel) & 1)) return NAN;
  if (!readRegister(coil, DATA_MSB + 2 * coil.channel, high)) return NAN;
  if (!readRegister(coil, DATA_MSB + 2 * coil.channel + 1, low)) return NAN;
  if (high >> 12) return NAN;
  return static_cast<float>((static_cast<uint32_t>(high) << 16) | low) * (CLOCK_HZ / 268435456.0f);
}

// ---- Pressures ------------------------------------------------------------------------------------------

float target_kpa[N_CHAMBERS];
unsigned long heard_ms = 0, vented_ms = 0;

float measured(int chamber) {
  const float share = static_cast<float>(analogRead(SENSOR_PIN[chamber])) / ((1 << ADC_BITS) - 1);
  return KPA_AT_0 + share * (KPA_AT_FULL - KPA_AT_0);
}

void closeValves(int chamber) {
  digitalWrite(FILL_PIN[chamber], LOW);
  digitalWrite(DRAIN_PIN[chamber], LOW);
}

// Open the valve that leads towards the set point, or none; never both, which would join supply and vacuum.
// Set points are within the limits, so a chamber above them is drained, and one below them is filled.
void regulate() {
  for (int k = 0; k < N_CHAMBERS; ++k) {
    const float kpa = measured(k);
    // A cut wire reads an end of the range whatever the pressure is: either valve would stay open for ever.
    if (kpa <= KPA_AT_0 + KPA_AT_END || kpa >= KPA_AT_FULL - KPA_AT_END) {
      closeValves(k);
      continue;
    }
    const float error = target_kpa[k] - kpa;
    if (error <= DEADBAND_KPA) digitalWrite(FILL_PIN[k], LOW);
    if (error >= -DEADBAND_KPA) digitalWrite(DRAIN_PIN[k], LOW);
    if (error > DEADBAND_KPA) digitalWrite(FILL_PIN[k], HIGH);
    if (error < -DEADBAND_KPA) digitalWrite(DRAIN_PIN[k], HIGH);
  }
}

// Let the set points go to zero once the computer is silent.
void ventIfSilent() {
  const unsigned long now_ms = millis();
  if (now_ms - heard_ms > SILENT_MS) {
    const float step = VENT_KPA_PER_S * static_cast<float>(now_ms - vented_ms) / 1000.0f;
    for (float &kpa : target_kpa) kpa -= kpa > step ? step : kpa < -step ? -step : kpa;
  }
  vented_ms = now_ms;
}

// ---- Lines ----------------------------------------------------------------------------------------------

char line[LONGEST];
size_t length = 0;
bool overlong = false;

void refuse(unsigned long number, const char *why) {
  Serial.print("E ");
  Serial.print(number);
  Serial.print(" ");
  Serial.print(why);
  Serial.print("\n");
}

void answerReadings(unsigned long number) {
  for (int k = 0; k < N_CHAMBERS; ++k) closeValves(k);  // until the transfers have ended
  Serial.print("R ");
  Serial.print(number);
  for (const Coil &coil : COILS) {
    const float hz = readCoil(coil);
    Serial.print(" ");
    if (isnan(hz)) {
      Serial.print("nan");
    } else {
      Serial.print(hz, 1);
    }
  }
  for (int k = 0; k < N_CHAMBERS; ++k) {
    Serial.print(" ");
    Serial.print(measured(k), 3);
  }
  Serial.print("\n");
}

void takePressures(unsigned long number, char *text) {
  float kpa[N_CHAMBERS];
  int n = 0;
  for (char *word = strtok(text, " "); word; word = strtok(nullptr, " "), ++n) {
    char *end;
    const float value = static_cast<float>(strtod(word, &end));
    if (*end || n == N_CHAMBERS) return refuse(number, "expected as many numbers as chambers");
    if (!(value >= MIN_KPA && value <= MAX_KPA)) return refuse(number, "pressure beyond the limits");
    kpa[n] = value;
  }
  if (n != N_CHAMBERS) return refuse(number, "expected as many numbers as chambers");
  memcpy(target_kpa, kpa, sizeof kpa);
  heard_ms = millis();
  Serial.print("P ");
  Serial.print(number);
  Serial.print("\n");
}

void answer(char *text) {
  char *end;
  if ((text[0] != 'R' && text[0] != 'P') || text[1] != ' ') return refuse(0, "expected R or P");
  const unsigned long number = strtoul(text + 2, &end, 10);
  if (end == text + 2 || (*end && *end != ' ')) return refuse(0, "expected a number after the letter");
  if (text[0] == 'P') return takePressures(number, end);
  answerReadings(number);
}

void serve() {
  while (Serial.available() > 0) {
    const char next = static_cast<char>(Serial.read());
    if (next != '\n') {
      overlong = overlong || length + 1 == LONGEST;
      if (!overlong) line[length++] = next;
      continue;
    }
    line[length] = '\0';
    length = 0;
    if (overlong) {
      refuse(0, "line too long");
    } else {
      answer(line);
    }
    overlong = false;
    return;  // one line, then the valves again
  }
}

// ---- Arduino --------------------------------------------------------------------------------------------

void setup() {
  for (int k = 0; k < N_CHAMBERS; ++k) {
    pinMode(FILL_PIN[k], OUTPUT);
    pinMode(DRAIN_PIN[k], OUTPUT);
    closeValves(k);
    target_kpa[k] = 0.0f;
  }
  analogReadResolution(ADC_BITS);
  Serial.begin(BAUD);
  Wire.begin();
  Wire.setClock(400000);
#ifdef WIRE_HAS_TIMEOUT
  Wire.setWireTimeout(1000, true);  // [us]; a bus that hangs does not stop loop()
#endif
  for (int k = 0; k < N_SPRINGS; ++k) {
    bool first = true;
    for (int j = 0; j < k; ++j) first = first && !sameChip(COILS[j], COILS[k]);
    if (first) startConverter(COILS[k]);
  }
}

void loop() {
  ventIfSilent();
  regulate();
  serve();
}

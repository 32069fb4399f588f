// Stand-in of Arduino's core: time, pins and a serial line of the host. board.cpp says what they do.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>

using std::isnan;
enum { LOW = 0, HIGH = 1, INPUT = 0, OUTPUT = 1 };

unsigned long millis();
void pinMode(uint8_t pin, uint8_t mode);
void digitalWrite(uint8_t pin, uint8_t level);
int analogRead(uint8_t pin);
void analogReadResolution(int bits);

class Line {
 public:
  void begin(unsigned long baud);
  int available();
  int read();
  void print(const char *text);
  void print(unsigned long number);
  void print(float value, int digits);
};
extern Line Serial;

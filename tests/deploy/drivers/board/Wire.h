// Stand-in of Arduino's Wire: a multiplexer with converters behind it; see board.cpp.
#pragma once
#include <cstdint>

class Bus {
 public:
  void begin();
  void setClock(uint32_t hz);
  void beginTransmission(uint8_t address);
  void write(uint8_t byte);
  uint8_t endTransmission(bool stop = true);
  uint8_t requestFrom(uint8_t address, uint8_t n);
  int read();
};
extern Bus Wire;

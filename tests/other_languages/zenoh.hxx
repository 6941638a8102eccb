// The part of zenoh-cpp's API that the example of the documentation uses, in its signatures of 1.9.0.
// A subscriber receives the lines of standard input, "KEY HEX", then ends. Without Zenoh's library.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <string>
#include <string_view>
#include <utility>
#include <variant>
#include <vector>

namespace zenoh {

class Config {
 public:
  static Config create_default() { return Config(); }
  void insert_json5(const std::string& key, const std::string& value) { settings_.emplace_back(key, value); }

 private:
  std::vector<std::pair<std::string, std::string>> settings_;
};

class KeyExpr {
 public:
  explicit KeyExpr(std::string_view text) : text_(text) {}
  std::string_view as_string_view() const { return text_; }

 private:
  std::string text_;
};

class Bytes {
 public:
  explicit Bytes(const std::string& hex) {
    for (std::size_t at = 0; at < hex.size(); at += 2) {
      bytes_.push_back(static_cast<std::uint8_t>(std::strtoul(hex.substr(at, 2).c_str(), nullptr, 16)));
    }
  }
  std::vector<std::uint8_t> as_vector() const { return bytes_; }

 private:
  std::vector<std::uint8_t> bytes_;
};

class Sample {
 public:
  Sample(const std::string& key, const std::string& hex) : key_(key), payload_(hex) {}
  const KeyExpr& get_keyexpr() const { return key_; }
  const Bytes& get_payload() const { return payload_; }

 private:
  KeyExpr key_;
  Bytes payload_;
};

namespace channels {

enum class RecvError { Z_DISCONNECTED };

class RingChannel {
 public:
  explicit RingChannel(std::size_t capacity) : capacity_(capacity) {}
  std::variant<Sample, RecvError> recv() const {
    std::string key, hex;
    if (std::cin >> key >> hex) return Sample(key, hex);
    return RecvError::Z_DISCONNECTED;
  }

 private:
  std::size_t capacity_;
};

}  // namespace channels

class Subscriber {
 public:
  explicit Subscriber(channels::RingChannel channel) : handler_(channel) {}
  const channels::RingChannel& handler() const { return handler_; }

 private:
  channels::RingChannel handler_;
};

class Session {
 public:
  static Session open(Config&&) { return Session(); }
  Subscriber declare_subscriber(const KeyExpr&, channels::RingChannel channel) const { return Subscriber(channel); }
};

}  // namespace zenoh

// Test nedbus's wire format against docs/vectors.json: g++ -std=c++17 vectors.cpp -o vectors, ./vectors vectors.json
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <iostream>
#include <limits>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <string>
#include <vector>

using nlohmann::json;
using Bytes = std::vector<std::uint8_t>;

// "float32[4]" is the base float32 with length 4; "char[8]" is one text of 8 bytes.
struct Type {
  explicit Type(const std::string& text) : base(text.substr(0, text.find('['))) {
    if (base != text) length = std::stoul(text.substr(base.size() + 1));
    is_array = length > 0 && base != "char";
    size = base == "bool" ? 0 : base == "char" ? length : std::stoul(base.substr(base.find_first_of("123468"))) / 8;
  }
  std::string base;
  std::size_t length = 0, size = 0;
  bool is_array = false;
};

void put(Bytes& out, std::uint64_t value, std::size_t size) {
  while (size-- > 0) out.push_back(static_cast<std::uint8_t>(value >> 8 * size));
}

std::uint8_t tag(const Type& type) {
  const auto step = type.size == 1 ? 0 : type.size == 2 ? 1 : type.size == 4 ? 2 : 3;
  if (type.base[0] == 'f') return type.size == 4 ? 0xca : 0xcb;
  return (type.base[0] == 'u' ? 0xcc : 0xd0) + step;
}

// A value of vectors.json: 64-bit integers, NaN and the infinities are strings.
double to_double(const json& value) {
  if (!value.is_string()) return value.get<double>();
  return value == "NaN" ? std::nan("") : value == "Infinity" ? HUGE_VAL : -HUGE_VAL;
}

void put_value(Bytes& out, const json& value, const Type& type) {
  if (type.base == "bool") return put(out, value.get<bool>() ? 0xc3 : 0xc2, 1);
  if (type.base == "char") {  // str 16 of the full length, padded with NUL
    auto text = value.get<std::string>();
    put(out, 0xda, 1), put(out, type.length, 2);
    text.resize(type.length, '\0');
    out.insert(out.end(), text.begin(), text.end());
    return;
  }
  put(out, tag(type), 1);
  if (type.base == "float32") {
    const auto number = static_cast<float>(to_double(value));
    std::uint32_t bits;
    std::memcpy(&bits, &number, 4), put(out, bits, 4);
  } else if (type.base == "float64") {
    const auto number = to_double(value);
    std::uint64_t bits;
    std::memcpy(&bits, &number, 8), put(out, bits, 8);
  } else if (value.is_string()) {
    const auto text = value.get<std::string>();
    put(out, text[0] == '-' ? static_cast<std::uint64_t>(std::stoll(text)) : std::stoull(text), 8);
  } else {
    put(out, static_cast<std::uint64_t>(value.get<std::int64_t>()), type.size);
  }
}

Bytes encode(const json& fields, int layout, const json& values) {
  Bytes out;
  put(out, 0xdc, 1), put(out, fields.size() + 1, 2), put(out, layout, 1);  // always array 16
  for (std::size_t i = 0; i < fields.size(); ++i) {
    const Type type(fields[i][1].get<std::string>());
    if (!type.is_array) {
      put_value(out, values[i], type);
      continue;
    }
    type.length < 16 ? put(out, 0x90 | type.length, 1) : (put(out, 0xdc, 1), put(out, type.length, 2));
    for (const auto& each : values[i]) put_value(out, each, type);
  }
  return out;
}

// Throw unless a decoded value has the type; return it in the form of vectors.json.
json checked(const json& value, const Type& type) {
  const auto fail = [] { throw std::runtime_error("type"); };
  if (type.base == "bool") return value.is_boolean() ? value : (fail(), value);
  if (type.base == "char") {
    if (!value.is_string()) fail();
    auto text = value.get<std::string>();
    text = text.substr(0, text.find('\0'));
    if (text.size() > type.length) fail();
    const auto dumped = json(text).dump(-1, ' ', false, json::error_handler_t::replace);  // U+FFFD for invalid UTF-8
    text = json::parse(dumped).get<std::string>();
    for (std::size_t at; (at = text.find("\xef\xbf\xbd")) != std::string::npos;) text.replace(at, 3, "?");
    return text;
  }
  if (!value.is_number()) fail();
  if (type.base[0] == 'f') {
    auto number = value.get<double>();
    if (type.size == 4) number = static_cast<float>(number);
    if (std::isnan(number)) return "NaN";
    if (std::isinf(number)) return number > 0 ? "Infinity" : "-Infinity";
    return number;
  }
  if (!value.is_number_integer()) fail();
  if (type.base[0] == 'u') {
    const auto most = type.size == 8 ? std::numeric_limits<std::uint64_t>::max() : (1ULL << 8 * type.size) - 1;
    if (!value.is_number_unsigned() || value.get<std::uint64_t>() > most) fail();
  } else {
    const auto most = type.size == 8 ? std::numeric_limits<std::int64_t>::max() : (1LL << (8 * type.size - 1)) - 1;
    if (value.is_number_unsigned() && value.get<std::uint64_t>() > static_cast<std::uint64_t>(most)) fail();
    if (value.get<std::int64_t>() < -most - 1) fail();
  }
  return type.size == 8 ? json(value.dump()) : value;
}

json decode(const json& definitions, const std::string& message, const Bytes& payload) {
  const auto array = json::from_msgpack(payload);  // throws for missing or trailing bytes
  if (!array.is_array() || array.empty() || !array[0].is_number_integer()) throw std::runtime_error("array");
  const auto& fields = definitions.at(message + "/" + array[0].dump());  // throws for an unknown layout
  if (array.size() != fields.size() + 1) throw std::runtime_error("count");
  auto values = json::array();
  for (std::size_t i = 0; i < fields.size(); ++i) {
    const Type type(fields[i][1].get<std::string>());
    const auto& value = array[i + 1];
    if (!type.is_array) {
      values.push_back(checked(value, type));
      continue;
    }
    if (!value.is_array() || value.size() != type.length) throw std::runtime_error("type");
    auto parts = json::array();
    for (const auto& each : value) parts.push_back(checked(each, type));
    values.push_back(parts);
  }
  return values;
}

Bytes from_hex(const std::string& hex) {
  Bytes out;
  for (std::size_t i = 0; i < hex.size(); i += 2) out.push_back(std::stoul(hex.substr(i, 2), nullptr, 16));
  return out;
}

// Return whether two values are equal; vectors.json may contain a float without a fraction as an integer.
bool same(const json& one, const json& other) {
  if (one.is_array()) return std::equal(one.begin(), one.end(), other.begin(), other.end(), same);
  if (one.is_number_float() && other.is_number()) {
    return one.get<double>() == other.get<double>() && std::signbit(one.get<double>()) == std::signbit(other.get<double>());
  }
  return one == other;
}

int main(int, char** argv) {
  const auto vectors = json::parse(std::ifstream(argv[1]));
  const auto& definitions = vectors.at("definitions");
  const auto check = [](bool is_true, const json& vector) {
    if (!is_true) throw std::runtime_error("vector fails: " + vector.at("name").get<std::string>());
  };
  for (const auto* kind : {"exact", "decode"}) {
    for (const auto& vector : vectors.at(kind)) {
      const auto message = vector.at("message").get<std::string>();
      const auto& fields = definitions.at(message + "/" + vector.at("layout").dump());
      const auto payload = from_hex(vector.at("payload"));
      check(same(decode(definitions, message, payload), vector.at("values")), vector);
      check(kind != std::string("exact") || encode(fields, vector.at("layout"), vector.at("values")) == payload, vector);
    }
  }
  for (const auto& vector : vectors.at("reject")) {
    auto is_rejected = vector.at("why") == "rule";
    try {
      decode(definitions, vector.at("message"), from_hex(vector.at("payload")));
    } catch (const std::exception&) {
      is_rejected = true;
    }
    check(is_rejected, vector);
  }
  std::cout << vectors.at("exact").size() << " exact, " << vectors.at("decode").size() << " decoded, "
            << vectors.at("reject").size() << " rejected\n";
}

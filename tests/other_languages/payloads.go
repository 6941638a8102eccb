// Print the values of payloads, given in hexadecimal: one line each, separated by spaces, texts in hexadecimal.
package main

import (
	"encoding/hex"
	"fmt"
	"os"

	"github.com/vmihailenco/msgpack/v5"
)

func print(value any) {
	switch value := value.(type) {
	case []any:
		for _, each := range value {
			print(each)
		}
	case string:
		fmt.Printf(" %x", value)
	case float32:
		fmt.Printf(" %v", float64(value))
	default:
		fmt.Printf(" %v", value)
	}
}

func main() {
	for _, text := range os.Args[1:] {
		payload, _ := hex.DecodeString(text)
		values, err := Decode(payload)
		if err != nil {
			panic(err)
		}
		print(values)
		fmt.Println()
	}
	var narrow struct {
		_msgpack struct{} `msgpack:",as_array"`
		Layout   uint8
		Count    uint8
	}
	fmt.Println(msgpack.Unmarshal([]byte{0x92, 0, 0xcd, 1, 44}, &narrow), narrow.Count) // 300 as a uint8
}

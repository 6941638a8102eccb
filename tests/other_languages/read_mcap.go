// Print the messages of a recording: a line "topic TAB times TAB type TAB definition TAB payload" for each.
package main

import (
	"fmt"
	"os"

	"github.com/foxglove/mcap/go/mcap"
)

func check(err error) {
	if err != nil {
		panic(err)
	}
}

func main() {
	file, err := os.Open(os.Args[1])
	check(err)
	reader, err := mcap.NewReader(file)
	check(err)
	messages, err := reader.Messages()
	check(err)
	check(mcap.Range(messages, func(schema *mcap.Schema, channel *mcap.Channel, message *mcap.Message) error {
		fmt.Printf("%s\t%d %d\t", channel.Topic, message.LogTime, message.PublishTime)
		fmt.Printf("%s\t%x\t%x\n", schema.Name, schema.Data, message.Data)
		return nil
	}))
}

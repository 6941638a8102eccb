// Print the values of payloads, given in hexadecimal: one line each, separated by spaces, texts in hexadecimal.
import java.util.HexFormat;
import org.msgpack.value.Value;

class Payloads {
    static String show(Value value) {
        if (value.isArrayValue()) {
            var text = new StringBuilder();
            value.asArrayValue().forEach(each -> text.append(show(each)));
            return text.toString();
        }
        if (value.isIntegerValue()) return " " + value.asIntegerValue().toBigInteger();
        if (value.isFloatValue()) return " " + value.asFloatValue().toDouble();
        if (value.isRawValue()) return " " + HexFormat.of().formatHex(value.asRawValue().asByteArray());
        return " " + value.asBooleanValue().getBoolean();
    }

    public static void main(String[] payloads) throws Exception {
        for (var text : payloads) System.out.println(show(Payload.decode(HexFormat.of().parseHex(text))));
    }
}

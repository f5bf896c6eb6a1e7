using System.Collections.Generic;
using System.Globalization;
using System.Text;

namespace Beam.Relightable {
    /// <summary>Reader of JSON: objects become dictionaries, arrays lists, numbers doubles.</summary>
    internal sealed class Json {
        private const int DeepestNesting = 64;
        private readonly string text;
        private int at;

        private Json(string text) {
            this.text = text;
        }

        /// <summary>Return the value that a text stands for.</summary>
        /// <exception cref="DeliveryException">The text is no JSON.</exception>
        public static object Parse(string text) {
            var reader = new Json(text);
            object value = reader.Value(0);
            reader.SkipSpace();
            DeliveryException.Require(reader.at == text.Length, "JSON must end after its value", reader.at);
            return value;
        }

        private object Value(int depth) {
            DeliveryException.Require(depth < DeepestNesting, "JSON must not be nested that deep", depth);
            switch (Next()) {
                case '{': return Object(depth + 1);
                case '[': return Array(depth + 1);
                case '"': return Text();
                case 't': return Word("true", true);
                case 'f': return Word("false", false);
                case 'n': return Word("null", null);
                default: return Number();
            }
        }

        private Dictionary<string, object> Object(int depth) {
            var found = new Dictionary<string, object>();
            at++;
            while (Next() != '}') {
                if (found.Count > 0) Take(',');
                DeliveryException.Require(Next() == '"', "JSON keys must be texts", at);
                string key = Text();
                Take(':');
                found[key] = Value(depth);
            }
            at++;
            return found;
        }

        private List<object> Array(int depth) {
            var found = new List<object>();
            at++;
            while (Next() != ']') {
                if (found.Count > 0) Take(',');
                found.Add(Value(depth));
            }
            at++;
            return found;
        }

        private string Text() {
            var found = new StringBuilder();
            for (at++; At() != '"'; at++) {
                char letter = At();
                DeliveryException.Require(letter >= ' ', "JSON texts must end and hold no control characters", at);
                found.Append(letter == '\\' ? Escaped() : letter);
            }
            at++;
            return found.ToString();
        }

        private char Escaped() {
            at++;
            int place = "\"\\/bfnrt".IndexOf(At());
            if (place >= 0) return "\"\\/\b\f\n\r\t"[place];
            int code = 0;
            bool isCode = At() == 'u' && at + 4 < text.Length && int.TryParse(
                text.Substring(at + 1, 4), NumberStyles.AllowHexSpecifier, CultureInfo.InvariantCulture, out code);
            DeliveryException.Require(isCode, "JSON escapes must be known", at);
            at += 4;
            return (char)code;
        }

        private object Number() {
            int start = at;
            while ("+-.0123456789eE".IndexOf(At()) >= 0) at++;
            double value;
            bool isNumber = double.TryParse(
                text.Substring(start, at - start), NumberStyles.Float, CultureInfo.InvariantCulture, out value);
            DeliveryException.Require(isNumber, "JSON must hold values", start);
            return value;
        }

        private object Word(string word, object value) {
            bool isThere = string.CompareOrdinal(text, at, word, 0, word.Length) == 0;
            DeliveryException.Require(isThere, "JSON must hold values", at);
            at += word.Length;
            return value;
        }

        private char At() => at < text.Length ? text[at] : '\0';

        private void SkipSpace() {
            while (at < text.Length && " \t\r\n".IndexOf(text[at]) >= 0) at++;
        }

        private char Next() {
            SkipSpace();
            return At();
        }

        private void Take(char mark) {
            DeliveryException.Require(Next() == mark, "JSON must have its marks, here '" + mark + "'", at);
            at++;
        }
    }
}

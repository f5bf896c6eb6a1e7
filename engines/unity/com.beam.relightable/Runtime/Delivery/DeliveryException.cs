using System;

namespace Beam.Relightable {
    /// <summary>A container breaks its format; the message is one line and names the file in it.</summary>
    public sealed class DeliveryException : Exception {
        /// <summary>Make an error of a line.</summary>
        public DeliveryException(string message) : base(message) {
        }

        internal static void Require(bool condition, string contract, object got) {
            if (condition) return;
            string text = Convert.ToString(got, System.Globalization.CultureInfo.InvariantCulture);
            text = text.Substring(0, Math.Min(text.Length, 80)).Replace('\n', ' ').Replace('\r', ' ');
            throw new DeliveryException(contract + ", got " + text + ". Export or download it again.");
        }
    }
}
